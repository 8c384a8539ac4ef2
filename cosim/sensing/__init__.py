"""What each AV knows of others: sensors, messages, tracks (docs/reference/sensing.md)."""
