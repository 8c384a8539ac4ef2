"""What rows say: statistics, comparisons and gates, reports, replays."""
