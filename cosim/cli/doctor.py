"""`cosim doctor`: the components of this installation, its faults, and their remedies."""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import metadata, util
from pathlib import Path

from cosim.cli import arguments

OK, WARN, FAIL = "ok", "warn", "FAIL"
DISTRIBUTION = "cosim-sumo"  # cosim's name on a package index
INSTALL = "pip install -e . -c constraints.txt"
REINSTALL = "pip install --force-reinstall libsumo"
# Libraries that `import libsumo` needs on a minimal Debian or Ubuntu (docs/reference/sumo.md).
APT_LINE = "apt-get install libx11-6 libxext6 libxrender1 libgl1 libatomic1"
# All need the same version: libsumo and sumolib are pinned together, eclipse-sumo rebuilds the nets.
SUMO_PACKAGES = ("libsumo", "sumolib", "traci", "eclipse-sumo", "sumo-data")
PROBE_LIMIT = 120.0  # s for `sumo --version` and `import libsumo`: 300 MB of libraries from a cold, busy disk
SIMULATION_LIMIT = 180.0  # s: numba compiles on the first run

_SIMULATE = """
import libsumo, sys
libsumo.start(["sumo", "-n", sys.argv[1], "--step-length", "0.1", "--no-step-log", "--no-warnings"])
libsumo.simulationStep(1.0)
time = libsumo.simulation.getTime()
libsumo.close()
print(f"simulated {time:g} s")
"""
_VERSION = "import libsumo; print(libsumo.getVersion()[1])"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the report; `fix` is the remedy, empty without a fault."""

    name: str
    state: str  # OK, WARN or FAIL
    detail: str
    fix: str = ""

    def line(self) -> str:
        return f"{self.state:<4} {self.name}: {self.detail}" + (f" ({self.fix})" if self.fix else "")


def add(commands: arguments.SubCommands) -> None:
    """Register the command and its flags."""
    doctor = commands.add_parser(
        "doctor",
        help="check this installation and say how to fix it",
        description="Check Python, libraries, SUMO and caches, and simulate a second. Each fault is named "
        "with its remedy; exit code 3 if there is one. With WHAT check whether the lanes of one network "
        "are far enough apart.",
    )
    doctor.add_argument(
        "scenario", nargs="?", metavar="WHAT", help="a scenario's name, its folder or a .sumocfg"
    )
    arguments.add(doctor, "--json")
    doctor.set_defaults(work=work)


def work(args: argparse.Namespace) -> int:
    """Print every check, as lines or as one JSON document; 0 when none failed, else 3."""
    checks: list[Check] = []
    for check in examine(os.environ) if args.scenario is None else [lanes(args.scenario)]:
        checks.append(check)
        if not args.json:
            print(check.line(), flush=True)
    failed = sum(check.state == FAIL for check in checks)
    if args.json:
        print(json.dumps({"failed": failed, "checks": [asdict(check) for check in checks]}))
    return 3 if failed else 0


def examine(environment: Mapping[str, str]) -> Iterator[Check]:
    """The checks in order (the simulation last, because it takes longest).

    `environment`: source of PATH, SUMO_HOME and NUMBA_CACHE_DIR.
    """
    yield Check("python", OK, f"{sys.version.split()[0]} at {sys.executable}")
    yield from packages(version_of)
    yield from sumo_packages(version_of)
    pinned = version_of("libsumo")
    yield from sumo_copies(environment, pinned)
    library = libsumo_library()
    yield library
    yield processors()
    yield numba_cache(environment)
    yield worlds()
    yield confinement()
    if library.state != FAIL:
        yield one_second()


def version_of(package: str) -> str | None:
    """The installed version of a distribution; nothing is imported."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def requirements() -> list[str]:
    """The distributions that cosim's own metadata asks for, but for extras and SUMO's."""
    with suppress(metadata.PackageNotFoundError):
        asked = [text for text in metadata.requires(DISTRIBUTION) or [] if "extra ==" not in text]
        names = [re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in asked]
        return [name for name in names if name not in SUMO_PACKAGES]
    return []


def packages(version: Callable[[str], str | None]) -> Iterator[Check]:
    """cosim and what it imports."""
    own = version(DISTRIBUTION)
    yield Check("cosim", OK, own) if own else Check("cosim", FAIL, "is not installed", INSTALL)
    found = {name: version(name) for name in requirements()}
    if missing := [name for name, number in found.items() if number is None]:
        fix = f"pip install -c constraints.txt {' '.join(missing)}"
        yield Check("packages", FAIL, f"missing: {', '.join(missing)}", fix)
    if there := ", ".join(f"{name} {number}" for name, number in found.items() if number is not None):
        yield Check("packages", OK, there)


def sumo_packages(version: Callable[[str], str | None]) -> Iterator[Check]:
    """SUMO's Python packages, which must all be of libsumo's version."""
    found = {name: number for name in SUMO_PACKAGES if (number := version(name)) is not None}
    pinned = found.get("libsumo")
    if pinned is None:
        yield Check("libsumo", FAIL, "is not installed", INSTALL)
        return
    for name, number in found.items():
        same = number == pinned
        state = OK if same else FAIL if name == "sumolib" else WARN
        detail = number if same else f"{number}, but libsumo is {pinned}"
        yield Check(name, state, detail, "" if same else f"pip install {name}=={pinned}")
    if "eclipse-sumo" not in found:
        text = "not installed: worlds run, nets cannot be rebuilt"
        yield Check("eclipse-sumo", WARN, text, f"pip install eclipse-sumo=={pinned}")


def sumo_copies(environment: Mapping[str, str], pinned: str | None) -> Iterator[Check]:
    """Every `sumo` program on PATH, and SUMO_HOME: unused by cosim, but a frequent cause of confusion."""
    seen: set[Path] = set()
    for folder in environment.get("PATH", "").split(os.pathsep):
        program = shutil.which("sumo", path=folder) if folder else None
        if program is None or Path(program).resolve() in seen:
            continue
        seen.add(Path(program).resolve())
        number = _program_version(program)
        if number is None:
            yield Check("sumo", WARN, f"{program} does not start", "cosim does not use it; fix or remove it")
            continue
        other = pinned is not None and number != pinned
        fix = f"cosim uses libsumo {pinned}; results of this copy may differ" if other else ""
        yield Check("sumo", WARN if other else OK, f"{number} at {program}", fix)
    if home := environment.get("SUMO_HOME"):
        yield (
            Check("SUMO_HOME", OK, f"{home} (not needed)")
            if (Path(home) / "data").is_dir()
            else Check("SUMO_HOME", WARN, f"{home} is no SUMO folder", "unset it: cosim does not need it")
        )


def libsumo_library() -> Check:
    """Whether `import libsumo` works, tested in a separate process."""
    if util.find_spec("libsumo") is None:
        return Check("libsumo library", FAIL, "is not installed", INSTALL)
    code, out, err = _run([sys.executable, "-c", _VERSION], PROBE_LIMIT)
    return Check("libsumo library", *((FAIL, *explain_import(code, err)) if code else (OK, out)))


def explain_import(code: int, stderr: str) -> tuple[str, str]:
    """The fault of a failed import of libsumo, and its remedy."""
    if missing := re.search(r"(lib[\w.+-]+\.so[\w.]*): cannot open shared object", stderr):
        return f"the system has no {missing[1]}", APT_LINE
    return _last_line(code, stderr.strip()), REINSTALL


def processors() -> Check:
    """Cores this process may use: evaluation and training take one process each."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    fix = "simulation and learning will share it" if count == 1 else ""
    return Check("processors", WARN if fix else OK, str(count), fix)


def numba_cache(environment: Mapping[str, str]) -> Check:
    """Numba's cache folder: without a writable one every process compiles the kernels again."""
    chosen = environment.get("NUMBA_CACHE_DIR")
    home = Path(environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME") or "/") / ".cache")
    source = Path(__file__).resolve().parents[1]
    # numba's own order: the chosen folder alone, or else beside the source, or else the user's cache.
    for folder in [Path(chosen)] if chosen else [source / "__pycache__", home]:
        if _writable(folder):
            return Check("numba cache", OK, str(folder))
    where = chosen or f"{source / '__pycache__'} and {home}"
    slow = f"cannot write {where}: every start compiles the kernels anew"
    return Check("numba cache", WARN, slow, "set NUMBA_CACHE_DIR to a writable folder")


def worlds() -> Check:
    """Whether the shipped scenarios are present."""
    import sumo_scenarios

    names = ", ".join(sumo_scenarios.names())
    return Check("scenarios", OK, names) if names else Check("scenarios", FAIL, "none found", INSTALL)


def confinement() -> Check:
    """Whether a server on this machine accepts uploads."""
    from cosim.service.confined import lacking

    if problem := lacking():
        return Check("uploads", WARN, f"{problem}: cosim serve takes none", "docs/guides/service.md, Uploads")
    return Check("uploads", OK, "confined by Landlock and seccomp")


def lanes(what: str) -> Check:
    """Whether a scenario's lanes are far enough apart for the vehicles on them. Raises BadInput."""
    from cosim.road.too_close import described, too_close
    from cosim.scenario import load
    from cosim.scenario.vet import vetted
    from cosim.simulation.net import NetReader
    from cosim.workers.worker import Worker

    worker = Worker(NetReader, vetted(load(what)).net)
    try:
        road = worker.call("road")
    finally:
        worker.close()
    found = described(road, too_close(road))
    return Check("lanes", WARN, found) if found else Check("lanes", OK, "far enough apart")


def one_second() -> Check:
    """One second of simulation of a shipped scenario in a separate process, through the whole loop."""
    with tempfile.TemporaryDirectory(prefix="cosim-doctor-") as folder:
        net = Path(folder) / "road.net.xml"
        net.write_text(_ROAD, encoding="utf-8")
        code, out, err = _run([sys.executable, "-c", _SIMULATE, str(net)], SIMULATION_LIMIT)
    if code != 0:
        return Check("simulation", FAIL, f"SUMO failed: {_last_line(code, err)}", REINSTALL)
    command = [sys.executable, "-m", "cosim.cli.main", "run", "merge", "--duration", "1", "--json"]
    code, whole, err = _run(command, SIMULATION_LIMIT)
    if code != 0 or not whole.startswith("{"):
        problem = f"libsumo works, cosim does not: {_last_line(code, err)}"
        return Check("simulation", FAIL, problem, f"see: cosim {' '.join(command[3:])}")
    return Check("simulation", OK, f"{out}; one second of merge through the whole loop")


def _program_version(program: str) -> str | None:
    _, out, _ = _run([program, "--version"], PROBE_LIMIT)
    found = re.search(r"sumo (?:Version )?v?(\d+[._]\d+[._]\d+)", out)
    return found[1].replace("_", ".") if found else None


def _run(command: list[str], limit: float) -> tuple[int, str, str]:
    """Exit code, stdout and stderr, both stripped; a process that hangs is killed after `limit` s."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return 124, "", f"no answer within {limit:g} s"
    except OSError as error:
        return 126, "", str(error)
    return done.returncode, done.stdout.strip(), done.stderr.strip()


def _last_line(code: int, stderr: str) -> str:
    return stderr.splitlines()[-1] if stderr else f"exit code {code}"


def _writable(folder: Path) -> bool:
    """Whether a file can be created in `folder`, or in its nearest existing parent."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return True
    except OSError:
        return False


# The smallest net SUMO loads: 100 m of one lane.
_ROAD = """<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,100,0" origBoundary="0,0,100,0" projParameter="!"/>
  <edge id="e" from="a" to="b" priority="-1">
    <lane id="e_0" index="0" speed="25" length="100" shape="0,-1.6 100,-1.6"/>
  </edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-3.2"/>
  <junction id="b" type="dead_end" x="100" y="0" incLanes="e_0" intLanes="" shape="100,-3.2 100,0"/>
</net>
"""
