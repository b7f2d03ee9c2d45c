"""Explanations of answers: the points that decided, slices and strips left out, smallest changes, nearest views."""
