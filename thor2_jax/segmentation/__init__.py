"""Instance masks for frames without labels, by the built-in segmenter for tables or those of other packages."""
