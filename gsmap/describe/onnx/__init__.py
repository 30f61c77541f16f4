"""ONNX models that users supply: validation before a map accepts a model, and text encoders."""
