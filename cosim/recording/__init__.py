"""Recorded episodes: written once, read back as snapshots, tracks and histories."""
