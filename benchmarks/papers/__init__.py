"""The papers' tables and figures on SUMO, each by one command; `python -m benchmarks.papers` makes all."""
