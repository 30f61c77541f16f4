"""ONNX models from users: validation before a map accepts one, and text encoders."""
