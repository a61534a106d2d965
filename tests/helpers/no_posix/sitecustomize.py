"""Takes from this program what only POSIX systems have. Also in child processes: this folder is on their PYTHONPATH.

Other packages and the standard library keep it, because they have branches for the system on which they really run.
"""

import builtins
import os
import signal
from types import ModuleType

OWN = ("scenes", "twin", "training", "hardware")
MODULES = {"termios", "pty", "tty", "fcntl", "resource", "grp", "pwd", "posix", "readline", "syslog"}
GONE = {
    "os": {
        *("fork", "forkpty", "killpg", "getpgid", "getpgrp", "setpgid", "setsid", "getsid", "getuid", "geteuid", "getgid", "getegid"),
        *("sched_getaffinity", "sched_setaffinity", "openpty", "ttyname", "mkfifo", "nice", "getloadavg", "statvfs", "sysconf", "uname"),
        *("register_at_fork", "posix_spawn", "wait", "wait3", "wait4", "pread", "pwrite", "chown", "chroot", "sync", "fchdir", "fchmod"),
        *("sendfile", "set_blocking", "get_blocking", "WNOHANG", "O_NONBLOCK", "O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC"),
    },
    "signal": {
        *("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGALRM", "SIGCHLD", "SIGTSTP", "SIGSTOP", "SIGCONT", "SIGKILL"),
        *("alarm", "setitimer", "pthread_sigmask", "pthread_kill", "sigwait", "sigwaitinfo", "sigtimedwait", "sigpending", "pause"),
        *("siginterrupt", "SIG_BLOCK", "SIG_SETMASK", "SIG_UNBLOCK"),
    },
}


class Without(ModuleType):
    """A module without some of its names."""

    def __init__(self, module, names):
        super().__init__(module.__name__)
        self.__dict__["_whole"], self.__dict__["_gone"] = module, names

    def __getattr__(self, name):
        if name in self._gone:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r} here")
        return getattr(self._whole, name)


LESS = {module.__name__: Without(module, GONE[module.__name__]) for module in (os, signal)}
_import = builtins.__import__


def guarded(name, globals=None, *rest, **named):
    """``__import__``, which gives this program's modules no POSIX modules, and less of others."""
    if str((globals or {}).get("__name__", "")).partition(".")[0] not in OWN:
        return _import(name, globals, *rest, **named)
    if name in MODULES:
        raise ModuleNotFoundError(f"No module named {name!r} here", name=name)
    return LESS.get(name) or _import(name, globals, *rest, **named)


builtins.__import__ = guarded
