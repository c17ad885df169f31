"""What a command says of what went wrong."""

import errno
import resource

from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime import extras

FULL = (errno.ENOSPC, errno.EDQUOT)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
THREADS = "can't start new thread"  # the interpreter's words


def sentence_of(error: Exception) -> str | None:
    """One sentence for a fault of the user or the system; None for one of the program."""
    if isinstance(error, PriorSgError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        return extras.advice(error)
    if isinstance(error, MemoryError):
        return f"there is not enough memory{_limit(resource.RLIMIT_AS, 'ulimit -v', 2**10)}; give it more"
    if isinstance(error, RuntimeError) and THREADS in str(error):
        return f"no more threads can be started{_of_threads()}; raise that limit"
    return _of_system(error) if isinstance(error, OSError) else None


def _of_system(error: OSError) -> str | None:
    where = f" {error.filename}" if error.filename else ""
    if error.errno in FULL:
        return f"there is no space left for{where or ' the results'}; free some, or write elsewhere"
    if error.errno in REFUSED:
        return f"cannot use{where or ' a file'} ({error.strerror}); choose another folder, or have its rights changed"
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"too many files are open{_limit(resource.RLIMIT_NOFILE, 'ulimit -n')}; raise that limit"
    if error.errno == errno.EAGAIN:
        return f"no more processes can be started{_limit(resource.RLIMIT_NPROC, 'ulimit -u')}; raise that limit"
    if error.errno == errno.ENOMEM:
        return f"there is not enough memory{_limit(resource.RLIMIT_AS, 'ulimit -v', 2**10)}; give it more"
    if error.errno == errno.ENAMETOOLONG:
        return f"the path{where} is too long; choose a shorter one"
    if isinstance(error, FileNotFoundError) and "temporary directory" in str(error):
        return "no temporary folder can be written; set TMPDIR to one that can be"
    return None


def _of_threads() -> str:
    """The limit that is met: each thread takes much of what addresses there are."""
    return _limit(resource.RLIMIT_AS, "ulimit -v", 2**10) or _limit(resource.RLIMIT_NPROC, "ulimit -u")


def _limit(which: int, name: str, unit: int = 1) -> str:
    soft, _ = resource.getrlimit(which)
    return "" if soft == resource.RLIM_INFINITY else f" (the limit `{name}` is {soft // unit})"
