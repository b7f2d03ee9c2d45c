"""Fitting of embeddings on views of many objects, most of them procedural."""
