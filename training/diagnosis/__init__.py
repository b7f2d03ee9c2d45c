"""Diagnosis of set-ups: likely mistakes in the files of a frame."""
