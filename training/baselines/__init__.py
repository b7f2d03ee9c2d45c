"""Other recognizers, to compare with: trained on a run's views, asked about the same described frames."""
