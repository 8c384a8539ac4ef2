"""Confined processes for uploads: they read only uploads and cosim's code, and write only their own folder.

Landlock restricts files, seccomp restricts system calls (no sockets, programs, processes), resources are
limited, and root loses its privileges. A confined process starts without the server's environment. Its
answers are read as plain data (`cosim.workers.untrusted`).

The simulation is imported after the process is confined, because numba chooses its cache at import. The
cache is a private copy, which no other process reads.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import math
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.errors import BadInput, CosimError
from cosim.files import cannot
from cosim.service import disk, landlock, privileges, seccomp
from cosim.service.settings import Limits, Settings
from cosim.workers.untrusted import untrusted

if TYPE_CHECKING:
    from cosim.envs.host import PolicyFactory, Reply
    from cosim.scenario import Scenario
    from cosim.scenario.options import EpisodeOptions
    from cosim.service.planner import Planner
    from cosim.service.watch import WatchedHost
    from cosim.types import ObservationConfig
    from cosim.workers.tasks import Progress

OPEN_FILES = 512
SCENARIO, POLICY = KINDS = ("scenario", "policy")
SUFFIXES = {SCENARIO: (".sumocfg", ".xml", ".xml.gz"), POLICY: (".safetensors", ".json")}
_SYSTEM = (
    "/usr", "/lib", "/lib64",
    "/etc/ld.so.cache", "/etc/localtime", "/etc/fonts", "/etc/ssl/openssl.cnf",
    "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/sys/devices/system",
    "/dev/random", "/dev/urandom",
)  # fmt: skip
_DEVICES = ("/dev/null", "/dev/zero")
_PACKAGES = ("cosim", "policy", "sumo_scenarios")
_NUMBA = "NUMBA_CACHE_DIR"


@dataclass(frozen=True, slots=True)
class Room:
    """Files and resources allowed to a confined process."""

    scratch: str  # folder of its temporary files, removed by the caller
    reads: tuple[str, ...] = ()  # readable besides the system's folders and Python's import folders
    writes: tuple[str, ...] = ()
    limits: Limits = Limits()

    def enter(self) -> None:
        """Confine this process permanently. Raises CosimError if `lacking` gives a reason."""
        if problem := lacking():
            raise CosimError(problem)
        os.dup2(2, 1)  # stdout belongs to the server
        privileges.drop((self.scratch, *self.writes))
        with cannot("make a folder there as an ordinary user", file=self.scratch):
            scratch = tempfile.tempdir = tempfile.mkdtemp(prefix=disk.folder_prefix(), dir=self.scratch)
        packages = [_folder(name) for name in _PACKAGES]
        _own_numba_cache(Path(scratch, "numba"), packages)
        for name in ("HOME", "MPLCONFIGDIR", "TORCHINDUCTOR_CACHE_DIR"):
            os.environ[name] = scratch
        os.chdir(scratch)
        limit_resources(self.limits)
        _limit(resource.RLIMIT_NPROC, privileges.tasks() + self.limits.tasks)
        python = [Path(path) for path in (sys.prefix, sys.base_prefix) if path != "/"]
        imports = [Path(path) for path in sys.path if os.path.isabs(path)]
        installed = [path for path in imports if path.name in ("site-packages", "dist-packages")]
        versions = [
            found for path in imports for kind in ("egg", "dist") for found in path.glob(f"*.{kind}-info")
        ]
        landlock.restrict(
            [*map(Path, (*_SYSTEM, *self.reads)), *python, *installed, *versions, *packages],
            [Path(scratch), *map(Path, (*_DEVICES, *self.writes))],
            imports,
        )
        seccomp.restrict()


def lacking() -> str:
    """The reason why uploads cannot be confined here; empty if they can."""
    if not landlock.version():
        return "this kernel has no Landlock to confine uploads"
    if not seccomp.available():
        return "this kernel has no seccomp to confine uploads, or is neither x86_64 nor aarch64"
    return "" if privileges.droppable() else "root cannot become an ordinary user here to confine uploads"


@contextlib.contextmanager
def room(settings: Settings, uploads: Sequence[str | Path], *writes: Path) -> Iterator[Room | None]:
    """The room for processes that use these uploads (ids, or a file); None without uploads.

    The scratch folder is removed afterwards. Raises BadInput if too much was written into it.
    """
    if not uploads:
        yield None
        return
    scratch = tempfile.mkdtemp(dir=settings.scratch)
    reads = tuple(str(settings.uploads / upload) for upload in uploads)
    try:
        with disk.limited(Path(scratch), writes, settings.limits):
            yield Room(scratch, reads, tuple(map(str, writes)), settings.limits)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def limit_resources(limits: Limits) -> None:
    """Limit this process's memory, files and descriptors; for processor time see `allow_processor_time`."""
    for limit, most in (
        (resource.RLIMIT_AS, limits.memory),
        (resource.RLIMIT_FSIZE, limits.file),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, OPEN_FILES),
    ):
        _limit(limit, most)


def _limit(limit: int, most: int) -> None:
    hard = resource.getrlimit(limit)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(limit, (most, most))


def allow_processor_time(seconds: float) -> None:
    """Allow `seconds` more of processor time; then the kernel ends the process (SIGXCPU)."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


@untrusted
class ConfinedRunner:
    """An `EpisodeRunner` in a confined process."""

    def __init__(self, room: Room) -> None:
        self._limits = room.limits
        room.enter()
        from cosim.batch.episode_runner import EpisodeRunner

        self._runner = EpisodeRunner()

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """One episode, as `EpisodeRunner.run`."""
        allow_processor_time(self._limits.cpu)
        with _memory_is_limited():
            return self._runner.run(case, warnings, outputs, progress)

    def close(self) -> None:
        """End the simulation."""
        self._runner.close()


@untrusted
class Drawer:
    """Drives an episode again and draws it: confined in a room, or only within the limits."""

    def __init__(self, room: Room | None, limits: Limits) -> None:
        if room is None:
            limit_resources(limits)
        else:
            room.enter()
        allow_processor_time(limits.cpu)

    def page(
        self,
        case: EpisodeOptions,
        manifest: Mapping[str, Any],
        trace_hash: str,
        target: str,
        progress: Progress,
    ) -> None:
        """Write the page of an episode of this manifest and hash. Raises BadInput, ReplayDiffers as
        `cosim replay`."""
        from cosim.host import Host
        from cosim.report.replay import episode

        recorded = episode.Recorded(case, (), manifest, trace_hash, Path())
        scenario, _ = episode.check_inputs(recorded)
        with (
            _memory_is_limited(),
            contextlib.closing(Host(scenario, case.policy, math.radians(case.svo_deg))) as host,
        ):

            def call(method: str, *arguments: Any, **options: Any) -> Any:
                return getattr(host, method)(*arguments, **options)

            _, recording = episode.driven(recorded, call, progress)
            episode.draw([recording], Path(target))


@untrusted
class Examiner:
    """Examines an upload in a confined process, so that faults there do not affect the server."""

    def __init__(self, room: Room) -> None:
        self._limits = room.limits
        room.enter()
        allow_processor_time(room.limits.check)

    def take(self, archive: str, folder: str, kind: str) -> tuple[str, dict[str, Any]]:
        """Unpack an archive into `folder`; returns the name of its .sumocfg or weights, and a description.

        Raises BadInput.
        """
        from cosim.service.archive import unpack
        from cosim.service.bundle import check_references, config_of, weights_of

        place = Path(folder)
        files = unpack(Path(archive), place, SUFFIXES[kind], self._limits)
        if kind == POLICY:
            main = weights_of(files)
            return str(main.relative_to(place)), self.policy(str(main))
        main = config_of(files)
        check_references(files, place)
        return str(main.relative_to(place)), self.scenario(str(main))

    def scenario(self, config: str) -> dict[str, Any]:
        """The description of a .sumocfg. Raises BadInput as `cosim.scenario.vet.vet`, or SUMO's refusal."""
        from cosim.host import sumo
        from cosim.scenario import load
        from cosim.scenario.vet import vet

        scenario = load(config)
        report = vet(scenario)
        with _memory_is_limited():
            sumo(scenario, {}, 1).close()  # a net that crashes SUMO does it here
        return {
            "edges": report.edges,
            "vehicles": report.vehicles,
            "flows": report.flows,
            "duration_s": scenario.duration,
            "warnings": list(report.warnings),
            "options_not_passed_on": list(scenario.ignored),
        }

    def policy(self, weights: str) -> dict[str, Any]:
        """The agent of the weights. Raises BadInput if weights and card do not match."""
        from cosim.policies import make

        with _memory_is_limited():
            policy = make(f"upload={weights}")
        return {"approach": type(policy).__name__, "label": policy.label}


@untrusted
def confined_planner(room: Room) -> Planner:
    """A `Planner` in a confined process."""
    room.enter()
    allow_processor_time(room.limits.check)
    from cosim.service.planner import Planner

    return Planner(room.limits)


def session_host(
    scenario: Scenario,
    observation: ObservationConfig,
    svo: float,
    reward: str,
    others: PolicyFactory | None,
) -> WatchedHost:
    """The host of a session. Call it in the session's process, since it imports the simulation."""
    from cosim.rewards import read
    from cosim.service.watch import WatchedHost

    return WatchedHost(scenario, observation, svo, read(reward, "reward"), others, None)


@untrusted
def confined_host(room: Room, *arguments: Any) -> WatchedHost:
    """The host of a session in a confined process; `arguments` are those of `session_host`."""
    room.enter()
    return timed_host(room.limits.cpu, *arguments)


def timed_host(seconds: float, *arguments: Any) -> WatchedHost:
    """The host of a session with `seconds` of processor time per episode; `arguments` as `session_host`."""
    allow_processor_time(seconds)
    host = session_host(*arguments)
    begin = host.reset

    def reset(seed: int) -> Reply:
        allow_processor_time(seconds)
        return begin(seed)

    setattr(host, "reset", reset)  # noqa: B010 - the worker calls this attribute
    return host


class _memory_is_limited:
    """Turn a MemoryError of the block into a BadInput."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: object, _: object) -> None:
        if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
            raise BadInput("needs more memory than an upload may use") from None


def _folder(package: str) -> Path:
    """The folder of a package, found without importing it."""
    spec = importlib.util.find_spec(package)
    assert spec is not None and spec.origin is not None, package  # noqa: PT018
    return Path(spec.origin).parent


def _own_numba_cache(target: Path, packages: Iterable[Path]) -> None:
    """Copy the compiled kernels to a writable folder, the only cache that numba reads."""
    given = os.environ.get(_NUMBA)
    os.environ[_NUMBA] = str(target)
    if given:
        if Path(given).is_dir():
            shutil.copytree(given, target, copy_function=shutil.copyfile)
        return
    for package in packages:
        for kernel in package.rglob("__pycache__/*.nb[ic]"):
            source = str(kernel.parents[1])  # numba's name for the folder in a given cache:
            name = f"{kernel.parents[1].name}_{hashlib.sha1(source.encode()).hexdigest()}"
            (target / name).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(kernel, target / name / kernel.name)
