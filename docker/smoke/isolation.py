"""Checks from inside the container that it has the restrictions of the smoke test."""

import os
import socket
import sys
from pathlib import Path


def refusals() -> dict[str, bool]:
    """Restriction -> whether it holds."""
    status = dict(
        line.split(":\t", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":\t" in line
    )
    return {
        "root": os.getuid() != 0,
        "capabilities": int(status["CapEff"], 16) == 0 and int(status["CapBnd"], 16) == 0,
        "new privileges": status["NoNewPrivs"].strip() == "1",
        "writing the root": not _writes("/") and not _writes("/opt/cosim") and not _writes("/scenarios"),
        "network interfaces": [name for _, name in socket.if_nameindex() if name != "lo"] == [],
        "writing to /tmp and /results must be possible": _writes("/tmp") and _writes("/results"),
    }


def _writes(folder: str) -> bool:
    probe = Path(folder) / f".probe-{os.getpid()}"
    try:
        probe.touch()
        probe.unlink()
    except OSError:
        return False
    return True


if __name__ == "__main__":
    open_doors = [name for name, refused in refusals().items() if not refused]
    print(f"possible in this container: {', '.join(open_doors)}" if open_doors else "locked up")
    sys.exit(1 if open_doors else 0)
