"""Evaluation on labelled datasets: answers, accuracy, confidence, fusion of classifiers and the report."""
