"""Image networks that the THOR2 paper compares with, in Flax NNX, with the names of the public PyTorch files."""
