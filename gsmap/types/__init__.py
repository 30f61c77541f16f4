"""Frozen data types that stages, processes and machines exchange. They import numpy only."""

from gsmap.types.cameras import Cameras
from gsmap.types.change import CHANGE_KINDS, Change, ChangeKind, ChangeReport
from gsmap.types.file_info import FileInfo
from gsmap.types.gaussians import Gaussians
from gsmap.types.map_object import OBSERVATION_STATES, MapObject, ObjectAnnotations, ObjectObservation, ObservationState
from gsmap.types.merging import MergeResult, PosedScene, ReferencePhoto
from gsmap.types.pose_graph import Edge, EdgeOutcome, PoseChange, PoseGraph, Prior, Provenance, ScenePose
from gsmap.types.registration import Proposal, Registration
from gsmap.types.room import Room
from gsmap.types.scene import Scene
from gsmap.types.scene_graph import NodeLayer, SceneGraph, Segments
from gsmap.types.sim3 import Sim3
from gsmap.types.source import GaussianSource
from gsmap.types.thinning import Thinning
from gsmap.types.tile import Tile

__all__ = [
    "CHANGE_KINDS",
    "OBSERVATION_STATES",
    "Cameras",
    "Change",
    "ChangeKind",
    "ChangeReport",
    "Edge",
    "EdgeOutcome",
    "FileInfo",
    "GaussianSource",
    "Gaussians",
    "ReferencePhoto",
    "MapObject",
    "MergeResult",
    "NodeLayer",
    "ObjectAnnotations",
    "PosedScene",
    "PoseChange",
    "PoseGraph",
    "Prior",
    "Proposal",
    "Provenance",
    "Registration",
    "Room",
    "Scene",
    "SceneGraph",
    "ScenePose",
    "ObjectObservation",
    "ObservationState",
    "Sim3",
    "Thinning",
    "Segments",
    "Tile",
]
