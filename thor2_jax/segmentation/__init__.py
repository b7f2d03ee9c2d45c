"""Instance masks for frames without labels: things on a table, and segmenters of other packages."""
