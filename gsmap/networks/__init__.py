"""ONNX networks supplied by users, each run in a separate process within limits. Only this room imports onnxruntime."""

from gsmap.networks.file import refuse_external_data
from gsmap.networks.process import ModelProcess

__all__ = ["ModelProcess", "refuse_external_data"]
