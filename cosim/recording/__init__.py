"""Recorded episodes: what was driven, written once, read back as snapshots, tracks and histories."""
