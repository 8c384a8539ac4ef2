"""What users send: archives of a scenario or of weights, unpacked with limits, examined, kept."""

from pathlib import Path

from cosim.service.problems import NotFound
from cosim.service.settings import Settings


class Uploads:
    """Those that the server keeps."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def file(self, upload: str, kind: str) -> Path:
        """Its .sumocfg (kind scenario) or its weights (kind policy). Raises NotFound, BadInput."""
        raise NotFound(f"no upload {upload!r}")
