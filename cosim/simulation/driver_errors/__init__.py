"""Errors of human drivers and pedestrians: one class per kind, and the trials."""
