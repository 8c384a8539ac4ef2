"""Replays: an episode recorded while it is driven, then drawn as an interactive page and as a film."""
