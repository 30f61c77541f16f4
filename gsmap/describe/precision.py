"""Round scene graphs to their significant digits, so that stored and matched values are equal and small.

All numbers are rounded to multiples of powers of two, which small integers represent without loss
(`gsmap.store.array_encoding`). Landmarks are accurate to centimetres, and embeddings of one place differ by tenths
between captures; the steps of a millimetre and 1/256 are far smaller.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.types import NodeLayer, SceneGraph, Segments

LENGTH_M = 0.001
"""Step of positions and extents in working metres; it is rounded to a power of two in the scene's unit."""

EMBEDDING = 1 / 256
"""Step of the components of landmark embeddings, a power of two. Components are clipped to 128 steps, so that each fits
a byte; of real landmarks, seven components in a million are clipped."""

LAB = 0.5
"""Step of colours in L*a*b* units; a power of two."""

DIGITS = 11
"""Number of significant binary digits of the weights and features of nodes."""


def round_graph(graph: SceneGraph) -> SceneGraph:
    """Return the scene graph with its numbers rounded."""
    step = float(2.0 ** np.round(np.log2(LENGTH_M / graph.working_m)))
    layers = {name: _layer(layer, step) for name, layer in graph.layers.items()}
    return replace(graph, layers=layers, segments=None if graph.segments is None else _segments(graph.segments, step))


def _layer(layer: NodeLayer, step: float) -> NodeLayer:
    features = _significant(layer.features, DIGITS)
    # The embedding of an object is its feature; the features of an image encoder all lie in one narrow cone.
    same = np.array_equal(layer.embeddings, layer.features)
    embeddings = features if same else _to(_within(layer.embeddings, EMBEDDING), EMBEDDING)
    positions = _to(layer.positions, step)
    around = layer.extents - layer.positions[:, None]  # relative to the position, so that a landmark stays symmetric
    return replace(
        layer,
        positions=positions,
        embeddings=embeddings,
        weights=_significant(layer.weights, DIGITS),
        extents=positions[:, None] + _to(around, step),
        features=features,
    )


def _segments(segments: Segments, step: float) -> Segments:
    return replace(
        segments,
        positions=_to(segments.positions, step),
        extents=_to(segments.extents, step),
        colours=_to(segments.colours, LAB),
        samples=_to(segments.samples, step),
        sample_colours=_to(segments.sample_colours, LAB),
    )


def _to(values: np.ndarray, step: float) -> np.ndarray:
    """Round values to multiples of a power of two, which are exact."""
    out: np.ndarray = np.round(values / step) * step + 0.0  # no -0
    return out


def _within(values: np.ndarray, step: float) -> np.ndarray:
    """Clip values to the range of a signed byte, in multiples of the step."""
    out: np.ndarray = np.clip(values, -128 * step, 127 * step)
    return out


def _significant(values: np.ndarray, digits: int) -> np.ndarray:
    mantissa, exponent = np.frexp(values)
    out: np.ndarray = np.ldexp(np.round(mantissa * 2.0**digits) / 2.0**digits, exponent) + 0.0
    return out
