"""As many digits of a graph as it is sure of: what is matched is then what is stored, bit for bit, in few bytes.

Everything is rounded to multiples of powers of two, which small integers hold without loss (`gsmap.store.narrow`).
Landmarks are placed to centimetres, and one place's embeddings differ by tenths between captures: a millimetre and a
256th are far below that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.types import NodeLayer, SceneGraph, Segments


@dataclass(frozen=True)
class Params:
    """How finely the numbers of a graph are told.

    Args:
        length_m: positions and extents, in working metres; the nearest power of two of the scene's unit is taken.
        embedding: components of the unit vectors that tell landmarks apart; a power of two. They are cut off at 128
            such steps, so that a byte holds each: of a real landmark's, seven in a million are larger than half.
        lab: colours of things, L*a*b* units; a power of two.
        digits: significant binary digits of the numbers of any size: weights, and features of nodes.
    """

    length_m: float = 0.001
    embedding: float = 1 / 256
    lab: float = 0.5
    digits: int = 11


def rounded(graph: SceneGraph, params: Params | None = None) -> SceneGraph:
    """The graph with its numbers rounded."""
    params = params or Params()
    step = float(2.0 ** np.round(np.log2(params.length_m / graph.working_m)))
    layers = {name: _layer(layer, step, params) for name, layer in graph.layers.items()}
    return replace(graph, layers=layers, things=None if graph.things is None else _things(graph.things, step, params))


def _layer(layer: NodeLayer, step: float, params: Params) -> NodeLayer:
    features = _significant(layer.features, params.digits)
    # An object's embedding is its feature; an image encoder's features all lie in one narrow cone.
    same = np.array_equal(layer.embeddings, layer.features)
    embeddings = features if same else _to(_within(layer.embeddings, params.embedding), params.embedding)
    positions = _to(layer.positions, step)
    around = layer.extents - layer.positions[:, None]  # of a landmark the same to all sides, and so it stays
    return replace(
        layer,
        positions=positions,
        embeddings=embeddings,
        weights=_significant(layer.weights, params.digits),
        extents=positions[:, None] + _to(around, step),
        features=features,
    )


def _things(things: Segments, step: float, params: Params) -> Segments:
    return replace(
        things,
        positions=_to(things.positions, step),
        extents=_to(things.extents, step),
        colours=_to(things.colours, params.lab),
        samples=_to(things.samples, step),
        sample_colours=_to(things.sample_colours, params.lab),
    )


def _to(values: np.ndarray, step: float) -> np.ndarray:
    """Multiples of a power of two; those are exact."""
    out: np.ndarray = np.round(values / step) * step + 0.0  # no -0
    return out


def _within(values: np.ndarray, step: float) -> np.ndarray:
    """Cut off at what a signed byte holds in such steps."""
    out: np.ndarray = np.clip(values, -128 * step, 127 * step)
    return out


def _significant(values: np.ndarray, digits: int) -> np.ndarray:
    mantissa, exponent = np.frexp(values)
    out: np.ndarray = np.ldexp(np.round(mantissa * 2.0**digits) / 2.0**digits, exponent) + 0.0
    return out
