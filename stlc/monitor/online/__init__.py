"""Online monitoring: verdicts as soon as they are decided, in bounded memory."""

from stlc.monitor.online.online import How, Online

__all__ = ["How", "Online"]
