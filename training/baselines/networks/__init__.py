"""Image networks with which the paper compares THOR2, in Flax NNX, with the names of the public PyTorch files."""
