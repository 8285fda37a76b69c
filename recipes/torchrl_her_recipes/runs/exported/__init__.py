"""Exported policies: what they expect, their networks, ONNX files, and model cards."""
