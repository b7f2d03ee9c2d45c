"""Surfaces of objects, with which the points of instances are compared."""
