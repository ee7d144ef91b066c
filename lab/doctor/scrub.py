"""Text without what tells of a person: home folder, user, host, paths, addresses."""

from __future__ import annotations

import getpass
import json
import os
import platform
import re
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

_WHOLE_WORDS = 5  # shorter names ("pi") are masked as whole words only, else they would be found in others
_ADDRESS = re.compile(r"(?<![0-9A-Za-z])(?:[0-9A-Fa-f]{2}([:_-]))(?:[0-9A-Fa-f]{2}\1){4}[0-9A-Fa-f]{2}(?![0-9A-Za-z])")
# macOS calls devices by these
_UUID = re.compile(r"(?<![0-9A-Za-z])[0-9A-Fa-f]{8}-(?:[0-9A-Fa-f]{4}-){3}[0-9A-Fa-f]{12}(?![0-9A-Za-z])")
# A text that is nothing but a path, or a device that is one; it may hold blanks.
_WHOLE_PATH = re.compile(
    r"(?P<device>(?:file|image|replay):)?(?P<path>(?:~?[/\\]|~$|[A-Za-z]:[/\\]|file://).*)", re.DOTALL
)
_SENTENCE = re.compile(r"[:;,] | \(|\n")
# A path within a text: from a root to a blank or a mark that ends it. `</x` and `//` of an address on the net are none.
_PATH = re.compile(
    r"""(?:(?<![\w<.:/\\])~?/(?=[^\s/"'<>|,;()\[\]{}])|(?<![A-Za-z])[A-Za-z]:(?:\\+|/(?!/))|(?<!\\)\\\\(?=\w)|(?<=file:)/+|(?<=<home>)[/\\]+)
        [^\s"'<>|,;:()\[\]{}]*""",
    re.VERBOSE,
)


class Scrubber:
    """Masks what would tell who made a bundle and where; the same thing bears the same mask everywhere.

    ``<home>``, ``<user>`` and ``<host>`` stand for the home folder, the user's names and the machine's, found in any
    case and in JSON's and the web's way of writing them; ``<path 1>`` for an absolute path, whose ending (``.mkv``)
    is kept; ``<address 1>`` for a Bluetooth address.

    Args:
        homes: home folders.
        users: login and full names.
        hosts: names of the machine.
    """

    def __init__(self, *, homes: Iterable[str], users: Iterable[str], hosts: Iterable[str]) -> None:
        self._secrets: list[tuple[re.Pattern[str], str]] = []
        for mask, names in (("<home>", homes), ("<host>", hosts), ("<user>", users)):
            known = {name.strip().rstrip("/\\") for name in names}
            for name in sorted((name for name in known if len(name) > 1), key=len, reverse=True):
                self._secrets.append((_pattern(name), mask))
        self._numbers: dict[tuple[str, str], int] = {}

    @classmethod
    def of_this_machine(cls) -> Scrubber:
        """One that knows this machine, its user and their home."""
        homes = {os.environ.get("HOME", ""), os.environ.get("USERPROFILE", "")}
        with suppress(RuntimeError, OSError):
            homes |= {str(Path.home()), str(Path.home().resolve())}
        users = {os.environ.get(name, "") for name in ("USER", "LOGNAME", "USERNAME", "SUDO_USER")}
        with suppress(OSError, KeyError, ImportError):
            users.add(getpass.getuser())
        with suppress(ImportError, KeyError, OSError):
            import pwd  # noqa: PLC0415 - there is none on Windows

            account = pwd.getpwuid(os.getuid())
            users |= {account.pw_name, account.pw_gecos.split(",")[0]}
            homes.add(account.pw_dir)
        users |= {Path(home).name for home in homes if home}
        hosts = {
            socket.gethostname(),
            platform.node(),
            os.environ.get("HOSTNAME", ""),
            os.environ.get("COMPUTERNAME", ""),
        }
        hosts |= {host.split(".")[0] for host in hosts}
        return cls(homes=homes - {"/"}, users=users, hosts=hosts - {"localhost"})

    def text(self, text: str) -> str:
        """A text with everything masked that is to be masked."""
        text = _ADDRESS.sub(lambda found: self._mask("address", re.sub("[:_-]", "", found[0])), text)
        text = _UUID.sub(lambda found: self._mask("address", found[0]), text)
        whole = _WHOLE_PATH.fullmatch(text)
        if whole is not None and not _SENTENCE.search(text):
            return (whole["device"] or "") + self._path(whole["path"])
        text = self._named(text)
        return self._named(_PATH.sub(lambda found: self._path(found[0]), text))

    def data(self, data: Any) -> Any:
        """JSON data with every text in it masked, keys too."""
        if isinstance(data, str):
            return self.text(data)
        if isinstance(data, Mapping):
            items = cast("Mapping[Any, Any]", data).items()
            return {self.text(str(key)): self.data(value) for key, value in items}
        if isinstance(data, (list, tuple)):
            return [self.data(item) for item in cast("list[Any]", data)]
        return data

    def lines(self, text: str) -> str:
        """JSON records, one a line, each masked; a line that is no record (torn, broken) is masked as a text."""
        return "\n".join(self._record(line) for line in text.split("\n"))

    def json(self, text: str) -> str:
        """A JSON file, masked; one that cannot be read as JSON is masked line by line."""
        try:
            return json.dumps(self.data(json.loads(text)), indent=2, ensure_ascii=False)
        except (ValueError, RecursionError):
            return self.lines(text)

    def _record(self, line: str) -> str:
        try:
            return json.dumps(self.data(json.loads(line)), ensure_ascii=False) if line.strip() else line
        except (ValueError, RecursionError):
            return self.text(line)

    def _named(self, text: str) -> str:
        for pattern, mask in self._secrets:
            text = pattern.sub(mask, text)
        return text

    def _path(self, path: str) -> str:
        ending = re.search(r"(?<=[^/\\.])\.[A-Za-z0-9]{1,8}$", path)
        return self._mask("path", path) + (ending[0] if ending else "")

    def _mask(self, kind: str, thing: str) -> str:
        number = self._numbers.setdefault((kind, thing.lower()), 1 + sum(kind == one for one, _ in self._numbers))
        return f"<{kind} {number}>"


def _pattern(name: str) -> re.Pattern[str]:
    """A name in all the ways in which a file may hold it, in any case."""
    forms = {name, name.replace("\\", "/")}
    forms |= {json.dumps(form)[1:-1] for form in forms} | {json.dumps(form, ensure_ascii=False)[1:-1] for form in forms}
    forms |= {quote(form, safe="/") for form in (name, name.replace("\\", "/"))}
    forms |= {form.replace("/", "\\/") for form in forms}
    forms |= {form.replace(" ", "\\ ") for form in forms} | {form.replace(" ", "_") for form in forms}
    either = "|".join(re.escape(form) for form in sorted(forms, key=len, reverse=True))
    return re.compile(either if len(name) >= _WHOLE_WORDS else rf"(?<![^\W_])(?:{either})(?![^\W_])", re.IGNORECASE)
