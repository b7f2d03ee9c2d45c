"""HTML pages, plots, and the page of an explanation."""
