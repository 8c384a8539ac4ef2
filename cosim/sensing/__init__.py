"""Each AV's knowledge of other objects: sensors, messages, tracks (docs/reference/sensing.md)."""
