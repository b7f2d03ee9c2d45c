"""Recordings and live cameras: frames from bags and RealSense cameras, and files with their detections."""
