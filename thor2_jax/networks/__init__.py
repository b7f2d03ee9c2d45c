"""Neural networks: classifiers of descriptors, and embeddings of clouds."""
