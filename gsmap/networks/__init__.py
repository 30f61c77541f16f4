"""ONNX networks from users, run in processes of their own within limits. Only this room imports onnxruntime."""

from gsmap.networks.file import refuse_external_data
from gsmap.networks.process import ModelProcess

__all__ = ["ModelProcess", "refuse_external_data"]
