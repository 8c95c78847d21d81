"""Memory that this process may still use, limited by the machine and by control groups.

A control group is a limit that the kernel keeps for a container or a unit of systemd; processes
beyond it are killed without a message.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from service.errors import Busy

WORKER_BYTES = 280 << 20
"""Memory in bytes of a process that computes replays, with the sky that it maps."""
REPLAY_BYTES = 96 << 20
"""Memory in bytes of a replay in the service's own process."""
RETRY_S = 60
_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def free_bytes(proc: Path = _PROC, groups: Path = _GROUPS) -> int | None:
    """Free memory in bytes under the tightest limit; None if the system reports none."""
    left = [*_of_machine(proc), *_of_groups(proc, groups)]
    return max(0, min(left)) if left else None


def require_memory_for_replay(starting_processes: int) -> None:
    """Raise `Busy` if memory lacks for a replay and for its processes that are not started yet."""
    needed = REPLAY_BYTES + starting_processes * WORKER_BYTES
    free = free_bytes()
    if free is not None and free < needed:
        raise Busy(
            f"a replay needs {needed >> 20} MB of memory and {free >> 20} MB are left; allow the "
            "service more, or fewer processes (ACQUIRE_REPLAY_PROCESSES)",
            RETRY_S,
        )


def _of_machine(proc: Path) -> Iterator[int]:
    with suppress(OSError):
        for line in (proc / "meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                yield 1024 * int(line.split()[1])


def _of_groups(proc: Path, groups: Path) -> Iterator[int]:
    """Memory left in the process's cgroups and their ancestors (v1 and v2), bytes."""
    try:
        lines = (proc / "self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            names = ("memory.max", "memory.current", "inactive_file")
            yield from _up_from(groups, path, *names)
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            yield from _up_from(groups / "memory", path, *names)


def _up_from(root: Path, path: str, limit: str, used: str, reclaimable: str) -> Iterator[int]:
    # In a container the path is the one outside of it, and the group itself is at the root.
    inside = root / path.lstrip("/")
    for folder in (inside, *inside.parents):
        # A group without a limit has "max", or a number beyond any memory.
        with suppress(OSError, ValueError, KeyError):
            most = int((folder / limit).read_text(encoding="ascii"))
            statistics = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
            counted = dict(each.split(maxsplit=1) for each in statistics)
            current = int((folder / used).read_text(encoding="ascii"))
            # The kernel reclaims inactive file pages first: count them as free.
            yield most - current + int(counted[reclaimable])
        if folder == root:
            return
