"""Evaluation as in the paper (section "Results"): answers of trained runs on a dataset, tables, pictures, a page."""
