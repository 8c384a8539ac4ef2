"""Evaluation of rows: statistics, comparisons and gates, reports, replays."""
