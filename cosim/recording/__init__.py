"""Recorded episodes: what was driven, written once, read back as snapshots, tracks and histories."""

from cosim.recording.file import Recording, read, write
from cosim.recording.folder import Folder
from cosim.recording.replay import Tracks, Windows, histories, tracks, windows
from cosim.recording.tape import Knowledge, RecordingSimulator, Tape

__all__ = [
    "Folder",
    "Knowledge",
    "Recording",
    "RecordingSimulator",
    "Tape",
    "Tracks",
    "Windows",
    "histories",
    "read",
    "tracks",
    "windows",
    "write",
]
