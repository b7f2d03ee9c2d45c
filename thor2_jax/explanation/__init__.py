"""Explanations of answers: attributions of points, omission of slices and strips, smallest changes, nearest views."""
