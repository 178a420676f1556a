"""Training of the learned corrections (extra [train]): data set in, ONNX file out."""
