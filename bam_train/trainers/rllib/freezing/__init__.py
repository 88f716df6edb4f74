"""A policy of RLlib as parts, as one ONNX graph, and the actions that prove it."""
