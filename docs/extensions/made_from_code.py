"""The reference's pages of commands and settings, made from the code when the site is built.

A page holds a comment, ``<!-- made: commands -->``, that is replaced by what is made.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from typing import Any

from sphinx.application import Sphinx
from typer.main import get_command

from lab.cli.main import app as commands
from lab.settings.settings import Settings

_MARK = re.compile(r"<!-- made: (\w+) -->")
_BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def commands_text() -> str:
    """Every command: what it does, its example, its arguments and options with their defaults."""
    return "\n".join(_command(get_command(commands), ("chordlab",)))


def _command(command: Any, words: tuple[str, ...]) -> Iterator[str]:
    inner: dict[str, Any] | None = getattr(command, "commands", None)
    if inner is not None:
        if len(words) > 1:
            yield f"## {' '.join(words)}\n\n{command.help}\n"
        for name, one in inner.items():
            yield from _command(one, (*words, name))
        return
    told, _, example = inspect.cleandoc(command.help or "").partition("Example:")
    yield f"{'#' * len(words)} {' '.join(words)}\n\n{told.strip()}\n\n```sh\n{example.strip()}\n```\n"
    yield "| given as | meaning | default |\n|---|---|---|"
    for parameter in command.params:
        if not getattr(parameter, "hidden", False):
            yield _parameter(parameter)
    yield ""


def _parameter(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        names = f"`{parameter.metavar or parameter.name.upper()}`"
        default = "required" if parameter.required else _value(parameter.default)
    else:
        value = "" if parameter.is_flag else f" {parameter.metavar or parameter.name.upper()}"
        names = ", ".join(f"`{option}{value}`" for option in (*parameter.opts, *parameter.secondary_opts))
        default = (
            "off" if parameter.default is False else "on" if parameter.default is True else _value(parameter.default)
        )
    return f"| {names} | {_cell(parameter.help or '')} | {default} |"


def _value(default: object) -> str:
    default = getattr(default, "value", default)  # of an enumeration
    return "–" if default is None or default == () or callable(default) else f"`{default}`"


def settings_text() -> str:
    """Every setting: section by section, with type, range, default and meaning."""
    schema = Settings.model_json_schema()
    return "\n".join(_section(schema, schema["$defs"], Settings().model_dump(mode="json"), ()))


def _section(
    schema: dict[str, Any], known: dict[str, Any], defaults: dict[str, Any], path: tuple[str, ...]
) -> Iterator[str]:
    many = path == ("virtual", "faults")
    title = "The session" if not path else f"`[[{'.'.join(path)}]]`" if many else f"`[{'.'.join(path)}]`"
    yield f"## {title}\n\n{_text(schema.get('description', ''))}\n"
    yield "| key | type | default | meaning |\n|---|---|---|---|"
    inner: list[tuple[str, dict[str, Any]]] = []
    required = schema.get("required", [])
    for name, field in schema["properties"].items():
        reference = field.get("$ref") or field.get("items", {}).get("$ref", "")
        table = known.get(reference.rpartition("/")[2], {})
        if "properties" in table:
            inner.append((name, table))
            continue
        default = "required" if name in required else _toml(defaults.get(name))
        yield f"| `{name}` | {_kind(field | table, known)} | {default} | {_cell(field.get('description', ''))} |"
    yield ""
    for name, table in inner:
        own = defaults.get(name) or {}
        if not isinstance(own, dict):
            own = {}
        if not own:
            own = {key: value.get("default") for key, value in table["properties"].items()}
        yield from _section(table, known, own, (*path, name))


def _kind(field: dict[str, Any], known: dict[str, Any]) -> str:
    if "$ref" in field and "enum" not in field:
        field = field | known[field["$ref"].rpartition("/")[2]]
    if "anyOf" in field:
        return " or ".join(_kind(one, known) for one in field["anyOf"])
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if field.get("type") == "array":
        items = field.get("prefixItems")
        if items:
            return f"{len(items)} × {_kind(items[0], known)}"
        return f"list of {_kind(field['items'], known)}"
    name = {"null": "none", "string": "path" if field.get("format") == "path" else "text"}.get(
        field["type"], field["type"]
    )
    bounds = ", ".join(f"{sign} {field[bound]:g}" for bound, sign in _BOUNDS.items() if bound in field)
    return f"{name} {bounds}".strip()


def _toml(value: object) -> str:
    return "none" if value is None else f"`{json.dumps(value, ensure_ascii=False)}`"


def _cell(text: str) -> str:
    return _text(text).replace("|", "\\|")


def _text(text: str) -> str:
    """A docstring's lines as one, in Markdown."""
    return " ".join(inspect.cleandoc(text).split()).replace("``", "`").replace("<", "&lt;")


MADE: dict[str, Callable[[], str]] = {"commands": commands_text, "settings": settings_text}


def fill(_app: Sphinx, _page: str, source: list[str]) -> None:
    """Put what is made in the place of its mark."""
    source[0] = _MARK.sub(lambda mark: MADE[mark[1]](), source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
