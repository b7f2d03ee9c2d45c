"""Diagnosis of set-ups: what is likely wrong with the files of a frame."""
