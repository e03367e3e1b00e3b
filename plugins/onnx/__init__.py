"""A stage that runs an ONNX network."""
