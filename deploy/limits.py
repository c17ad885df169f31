"""What the system must let this user's processes do."""

import resource

from prior_sg.deploy.errors import UserError

MEMORY_NEEDED_B = 2_000_000 * 1024  # addresses, not memory in use
FILES_WANTED, FILES_NEEDED = 1024, 48  # open at once


def check_memory(extra: str) -> None:
    """That numeric packages may take what they need: some of them end the process without a word. Raises UserError."""
    limit_b, _ = resource.getrlimit(resource.RLIMIT_AS)
    if extra and limit_b != resource.RLIM_INFINITY and limit_b < MEMORY_NEEDED_B:
        raise UserError(f"`ulimit -v` is {limit_b // 1024}; raise that limit to {MEMORY_NEEDED_B // 1024}")


def files_allowed() -> int:
    """How many files a process may open at once when it raises its limit as far as it may, up to what is wanted."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    return FILES_WANTED if hard == resource.RLIM_INFINITY else min(FILES_WANTED, hard)


def fault_of_files(allowed: int) -> str:
    """One sentence for a limit of open files that is too low for a router; empty for one that is not."""
    if allowed >= FILES_NEEDED:
        return ""
    return f"only {allowed} files may be open at once (`ulimit -n`); raise that limit to {FILES_WANTED}"
