"""ONNX models that a user gives: their files, their sessions, and the check before one is taken in."""
