"""HTML pages, plots and pictures of instances."""
