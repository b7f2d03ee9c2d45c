"""Recognition from a few views: objects are enrolled as embedded views, with which queries are compared."""
