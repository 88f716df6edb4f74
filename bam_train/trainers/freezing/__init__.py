"""What freezing a policy takes, whichever library trained it: layers, golden observations, the ONNX file."""
