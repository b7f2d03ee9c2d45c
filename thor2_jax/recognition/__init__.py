"""From RGB-D frames to object names: instance clouds, classifiers, the recognizer and its files."""
