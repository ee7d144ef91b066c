"""What can go wrong between the host and a robot, each with its cause, its cure and its data."""

from __future__ import annotations

from collections.abc import Sequence

from lab.base.errors import ChordlabError, RequestError


class RobotError(ChordlabError):
    """Root of the robot's errors; ``robot`` is the name it was asked for by."""

    def __init__(self, message: str, *, robot: str) -> None:
        super().__init__(message)
        self.robot = robot


class BluetoothUnavailableError(RobotError):
    """The host's own radio is missing, off or forbidden; ``reason`` is what the system said.

    Switch Bluetooth on, or give this program the right to use it.
    """

    def __init__(self, robot: str, reason: str) -> None:
        super().__init__(
            f"no Bluetooth on this machine ({reason}): switch it on and let this program use it, "
            "or run with the virtual robot",
            robot=robot,
        )
        self.reason = reason


class RobotNotFoundError(RobotError):
    """No advertisement carried the name within ``timeout_s``; ``seen`` are the robots that were heard.

    A robot that sleeps, or that another program or machine holds, does not advertise.
    """

    def __init__(self, robot: str, *, timeout_s: float, seen: Sequence[str] = ()) -> None:
        heard = f"heard only {', '.join(sorted(seen))}" if seen else "heard no robot at all"
        super().__init__(
            f"no robot called {robot} within {timeout_s:g} s ({heard}): one that sleeps or is connected elsewhere does "
            "not advertise, so shake it awake, close other apps that hold it, or look with `chordlab robot scan`",
            robot=robot,
        )
        self.timeout_s = timeout_s
        self.seen = tuple(seen)


class RobotUnreachableError(RobotError):
    """The robot was heard but did not take the connection; ``address`` and ``reason`` say which and why.

    It is at the edge of the range, or somebody else was quicker.
    """

    def __init__(self, robot: str, *, address: str, reason: str) -> None:
        super().__init__(
            f"{robot} ({address}) was heard but does not connect ({reason}): bring it closer, "
            "close other apps that hold it, and try again",
            robot=robot,
        )
        self.address = address
        self.reason = reason


class NotABoltError(RobotError):
    """What carries the name at ``address`` is another kind of device: it lacks the characteristic ``missing``."""

    def __init__(self, robot: str, *, address: str, missing: str) -> None:
        super().__init__(
            f"{robot} ({address}) is no Sphero BOLT (it lacks the characteristic {missing}): "
            "take a name that `chordlab robot scan` lists",
            robot=robot,
        )
        self.address = address
        self.missing = missing


class NotConnectedError(RobotError):
    """A command was given before ``connect`` or after the link was gone."""

    def __init__(self, robot: str, command: str) -> None:
        super().__init__(f"{robot} is not connected, so `{command}` cannot be sent: connect first", robot=robot)
        self.command = command


class LinkLostError(RobotError):
    """The link broke while an answer was awaited; ``reason`` says how it was noticed."""

    def __init__(self, robot: str, reason: str) -> None:
        super().__init__(f"lost the link to {robot} ({reason}): bring it closer and connect again", robot=robot)
        self.reason = reason


class ReplyTimeoutError(RobotError):
    """``command`` was written, no answer came within ``timeout_s``."""

    def __init__(self, robot: str, command: str, *, timeout_s: float) -> None:
        super().__init__(
            f"{robot} did not answer `{command}` within {timeout_s:.3g} s: "
            "bring it closer, or wake it and connect again",
            robot=robot,
        )
        self.command = command
        self.timeout_s = timeout_s


class ReconnectError(RobotError):
    """A lost robot did not come back within ``give_up_s``; ``attempts`` were made, the last failed for ``reason``."""

    def __init__(self, robot: str, *, attempts: int, give_up_s: float, reason: str) -> None:
        tries = "attempt" if attempts == 1 else "attempts"
        super().__init__(
            f"{robot} did not come back in {give_up_s:g} s and {attempts} {tries}: charge it, bring it closer, "
            f"and connect again; the last one: {reason}",
            robot=robot,
        )
        self.attempts = attempts
        self.give_up_s = give_up_s
        self.reason = reason


class CommandError(RobotError):
    """The robot refused ``command`` with ``code`` (``meaning`` in words)."""

    def __init__(self, robot: str, command: str, *, code: int, meaning: str) -> None:
        super().__init__(
            f"{robot} refused `{command}`: {meaning} (error 0x{code:02X}); "
            "compare its firmware by `chordlab robot info`",
            robot=robot,
        )
        self.command = command
        self.code = code
        self.meaning = meaning


class PayloadError(ChordlabError):
    """A payload of ``command`` does not have the layout that it should have: ``data`` holds its bytes."""

    def __init__(self, command: str, data: bytes, *, expected: str) -> None:
        super().__init__(
            f"`{command}` carried {len(data)} bytes ({data[:24].hex()}), expected {expected}: "
            "the firmware speaks another dialect; update the robot"
        )
        self.command = command
        self.data = data


class RadioError(ChordlabError):
    """The virtual radio was used before ``start`` or after ``close``."""


class DriveError(RequestError):
    """A speed, heading, level or time outside what the robot can do was asked for; ``value`` is what was asked."""

    def __init__(self, message: str, *, value: float) -> None:
        super().__init__(message)
        self.value = value
