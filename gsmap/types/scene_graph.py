"""An object-level scene graph."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import InputError


@dataclass(frozen=True, eq=False)
class NodeLayer:
    """A set of M nodes of one kind, whose embeddings can be compared with those of the same layer in another scene.

    Args:
        positions: (M, 3) float64, scene frame and unit.
        embeddings: (M, D) float32 unit vectors that tell nodes apart: what a landmark's surroundings look like; an
            object's feature, to which its context is joined when two layers are compared.
        types: (M,) int32; nodes match only within a type (landmarks: channel x sign x scale; objects: all 0).
        weights: (M,) float32 confidence (objects) or response (landmarks), larger is better.
        extents: (M, 2, 3) float64 lowest and highest corner of the node's points, scene frame.
        features: (M, F) float32 an object's feature; a landmark's response and scale.
        num_views: (M,) int32 how many rendered views saw the node; 0 where nothing was rendered.
        descriptor_id: digest of everything that decides what a node and its embedding mean; layers of different ids
            are never compared.
        unit_m: metres per scene unit that the layer was made under. ``positions * unit_m`` is in (assumed) metres, and
            all metric constants hold there; two layers of one descriptor may be compared whatever their units.
    """

    positions: np.ndarray
    embeddings: np.ndarray
    types: np.ndarray
    weights: np.ndarray
    extents: np.ndarray
    features: np.ndarray
    num_views: np.ndarray
    descriptor_id: str
    unit_m: float = 1.0

    def __post_init__(self) -> None:
        kinds = {
            "positions": np.float64,
            "embeddings": np.float32,
            "types": np.int32,
            "weights": np.float32,
            "extents": np.float64,
            "features": np.float32,
            "num_views": np.int32,
        }
        m = len(self.positions)
        for name, dtype in kinds.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if len(array) != m:
                raise InputError(f"NodeLayer.{name} has {len(array)} rows, positions have {m}", code="shape_mismatch")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise InputError(f"NodeLayer.{name} holds NaN or infinity", code="not_finite")
            object.__setattr__(self, name, array)
        if not (np.isfinite(self.unit_m) and self.unit_m > 0):
            raise InputError(f"NodeLayer.unit_m must be positive, got {self.unit_m}", code="invalid_metre")

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def empty(cls, descriptor_id: str, dim: int = 1, unit_m: float = 1.0) -> NodeLayer:
        z = np.zeros
        return cls(z((0, 3)), z((0, dim)), z(0), z(0), z((0, 2, 3)), z((0, dim)), z(0), descriptor_id, unit_m)


@dataclass(frozen=True, eq=False)
class Segments:
    """The segments of a scene: connected groups of Gaussians, each of which is one physical object.

    Args:
        members: (N,) int32 segment of each Gaussian, in the scene's order; -1 for the building and for floaters.
        positions: (M, 3) float64 mean of the members, scene frame and unit.
        extents: (M, 2, 3) float64 lowest and highest corner around the members, scene frame and unit.
        colours: (M, 3) float32 median colour, CIE L*a*b* (D65).
        samples: (K, 3) float64 mean of the members in each small cell, scene frame and unit, sorted by segment.
        sample_colours: (K, 3) float32 mean colours of the samples.
        sample_counts: (M,) int32 number of samples of each segment.
        unit_m: metres per scene unit at which they were segmented.

    Raises:
        InputError: arrays of inconsistent shapes or values.
    """

    members: np.ndarray
    positions: np.ndarray
    extents: np.ndarray
    colours: np.ndarray
    samples: np.ndarray
    sample_colours: np.ndarray
    sample_counts: np.ndarray
    unit_m: float = 1.0

    def __post_init__(self) -> None:
        kinds = {"members": np.int32, "positions": np.float64, "extents": np.float64, "colours": np.float32}
        kinds |= {"samples": np.float64, "sample_colours": np.float32, "sample_counts": np.int32}
        for name, dtype in kinds.items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=dtype))
        m = len(self.positions)
        shapes = {"positions": (m, 3), "extents": (m, 2, 3), "colours": (m, 3), "members": (self.members.size,)}
        shapes["sample_counts"] = (m,)
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise InputError(f"Segments.{name} must have shape {shape}, got {array.shape}", code="shape_mismatch")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise InputError(f"Segments.{name} holds NaN or infinity", code="not_finite")
        counted = int(self.sample_counts.sum())
        if (self.sample_counts < 0).any() or not self.samples.shape == self.sample_colours.shape == (counted, 3):
            raise InputError(
                f"Segments has counts of {counted} samples and {self.samples.shape} of them", code="shape_mismatch"
            )
        if not (np.isfinite(self.samples).all() and np.isfinite(self.sample_colours).all()):
            raise InputError("Segments.samples holds NaN or infinity", code="not_finite")
        if self.members.size and not (self.members.min() >= -1 and self.members.max() < m):
            raise InputError(f"Segments.members refers to segments outside -1 to {m - 1}", code="shape_mismatch")
        if not (np.isfinite(self.unit_m) and self.unit_m > 0):
            raise InputError(f"Segments.unit_m must be positive, got {self.unit_m}", code="invalid_metre")

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class SceneGraph:
    """The nodes of one scene, by layer. Edges are not stored: every two nodes are connected by their distance.

    Args:
        scene_id: the scene it describes.
        layers: by name; a layer that was not made is absent. ``objects``; ``landmarks`` takes the scene's unit for
            a metre, and ``landmarks@K`` takes it for 2 to the power -K of one; ``landmarks:0``, ``:1``, ``:2`` are the
            landmarks at ``unit_m`` times 1.45 to the powers -2, 0, 1: for any two captures of one place, whatever their
            units, two of them agree to within 20 percent (`gsmap.describe.unit`). ``landmarks_gravity_free`` (or
            ``landmarks_gravity_free:1``) are the landmarks of a scene that knows up as they compare with those of
            scenes that do not.
        up: (3,) unit vector against gravity in the scene frame, or None where it could not be told.
        unit_m: guess of metres per scene unit (good to a factor of about 2); 1 where the scale is known.
        notes: remarks (few nodes, no gravity, ...).
        segments: segments of its Gaussians; None if they were not computed, as in graphs of older releases.
        working_m: working metres per scene unit: the lengths of landmarks, refinement and evidence hold in them. The
            metre, where that may be the unit and the scene is seen as rooms are; else what makes it look like one.
    """

    scene_id: str
    layers: dict[str, NodeLayer] = field(default_factory=dict)
    up: np.ndarray | None = None
    unit_m: float = 1.0
    notes: tuple[str, ...] = ()
    segments: Segments | None = None
    working_m: float = 1.0

    @property
    def num_nodes(self) -> int:
        return sum(len(layer) for layer in self.layers.values())
