"""A Python without what Windows lacks: with this folder on `PYTHONPATH`, every interpreter starts like that.

It lacks the modules, functions, flags and signals of POSIX, and finds no C compiler.
"""

import ctypes.util  # noqa: F401 - asks for the name of the system
import multiprocessing.popen_fork
import os
import select
import shutil
import signal
import subprocess
import sys

MODULES = ("fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog")
SYSTEM = (
    *("fork", "forkpty", "register_at_fork", "killpg", "getpgid", "setsid", "set_blocking", "get_blocking"),
    *("geteuid", "getegid", "fchmod", "mkfifo", "sysconf", "getloadavg", "nice"),
    *("sched_getaffinity", "sched_setaffinity", "O_NONBLOCK", "O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC"),
)
SIGNALS = (
    *("SIGALRM", "SIGKILL", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGCHLD"),
    *("alarm", "setitimer", "pthread_kill", "pthread_sigmask", "sigwait"),
)
COMPILERS = ("cc", "gcc", "clang", "tcc", "c++", "g++")


def _found_elsewhere(which):
    return lambda name, *rest, **options: None if name in COMPILERS else which(name, *rest, **options)


sys.modules.update(dict.fromkeys(MODULES))
for _module, _names in ((os, SYSTEM), (signal, SIGNALS), (select, ("poll", "epoll"))):
    for _name in _names:
        if hasattr(_module, _name):
            delattr(_module, _name)
for _process in (subprocess.Popen, multiprocessing.popen_fork.Popen):
    _process.kill = _process.terminate  # as on Windows
shutil.which = _found_elsewhere(shutil.which)
os.environ.pop("CC", None)
multiprocessing.set_start_method("spawn")
os.name = "neither"
