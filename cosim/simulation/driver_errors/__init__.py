"""Errors of human drivers and of persons on foot: one class a kind, and the trials of all."""
