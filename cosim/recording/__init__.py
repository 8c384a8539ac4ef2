"""Recorded episodes: what was driven, written once, read back as snapshots, tracks and histories."""

from cosim.recording.file import Recording, read, write
from cosim.recording.folder import Folder
from cosim.recording.recorder import DRAWN, Choice, Knowledge, Recorder
from cosim.recording.views import Tracks, Windows, histories, tracks, windows

__all__ = [
    "DRAWN",
    "Choice",
    "Folder",
    "Knowledge",
    "Recorder",
    "Recording",
    "Tracks",
    "Windows",
    "histories",
    "read",
    "tracks",
    "windows",
    "write",
]
