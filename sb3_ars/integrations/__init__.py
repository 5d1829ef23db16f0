"""Ties to other people's tools (RL Zoo, Hugging Face hub, ONNX); nothing else of the package needs them."""
