"""Replays: an episode watched while it is driven, then drawn as an interactive page and as a film."""
