"""Robots, points, corpora and a browser that several tests share."""
