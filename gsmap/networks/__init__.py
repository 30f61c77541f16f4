"""Networks that users give, as ONNX files: run in processes of their own, within limits. Only here is onnxruntime."""

from gsmap.networks.file import refuse_external_data
from gsmap.networks.process import ModelProcess

__all__ = ["ModelProcess", "refuse_external_data"]
