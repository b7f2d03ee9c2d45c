"""Recognition from few views: objects are enrolled as embedded views, and queries are compared with them."""
