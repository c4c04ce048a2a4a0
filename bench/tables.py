"""Tables of results, as every benchmark's TABLES describe them, and the pages that the site's build makes of them."""

from __future__ import annotations

import importlib
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.common import RESULTS, ROOT, cell, commit, place

Row = Mapping[str, Any]
Column = str | Callable[[Any], Any]


class Table(NamedTuple):
    """How one table shows rows of results."""

    title: str  # "{}" stands for the keys that the path's stars are
    rows: str = ""  # path to the rows, its parts joined by slashes; "*" is each key or row there
    columns: Mapping[str, Column] | Sequence[str] = ()  # by header, a key, "a/b": b of a, or a function; (): all plain
    by: str = ""  # a key: rows that are alike in it become one, whose columns are functions of their list
    only: Callable[[Row], Any] | None = None  # which rows are shown
    most: Callable[[Row], Any] | None = None  # the rows of the largest values are shown, 12 at most
    note: str = ""


def text_of(name: str, results: Any) -> str:
    """The tables of a benchmark's results as Markdown."""
    described = getattr(importlib.import_module(f"bench.{name}"), "TABLES", ())
    return "\n".join(text for table in described for text in rendered(table, results))


def rendered(table: Table, results: Any) -> Iterator[str]:
    for keys, rows in found(results, [part for part in table.rows.split("/") if part]):
        rows = [row for row in rows if isinstance(row, Mapping) and (table.only is None or table.only(row))]
        if table.most is not None:
            rows = sorted(rows, key=table.most, reverse=True)[:12]
        if not rows:
            continue
        columns = table.columns or {key: key for key, value in rows[0].items() if not isinstance(value, (dict, list))}
        if not isinstance(columns, Mapping):
            columns = {key: key for key in columns}
        header = [name.replace("_", " ") for name in columns]
        if table.by:
            groups: dict[Any, list[Row]] = {}
            for row in rows:
                groups.setdefault(row[table.by], []).append(row)
            lines = [[key, *(of(group) for of in columns.values())] for key, group in groups.items()]  # type: ignore
            header = [table.by.replace("_", " "), *header]
        else:
            lines = [[value_of(row, column) for column in columns.values()] for row in rows]
        note = f"{inspect.cleandoc(table.note)}\n\n" if table.note else ""
        yield f"## {table.title.format(*keys)}\n\n{note}{markdown_table(header, lines)}"


def found(value: Any, path: list[str], keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """Lists of rows at a path, with the keys that stars are there. A group's own rows need no part of the path."""
    if isinstance(value, dict) and "rows" in value and (not path or path[0] not in value):
        value = value["rows"]
    if not path:
        yield keys, value if isinstance(value, list) else [value]
        return
    first, *rest = path
    if first == "*":
        items = value.items() if isinstance(value, dict) else ((title_of(row), row) for row in value)
        for key, inner in items:
            if isinstance(inner, (dict, list)):
                yield from found(inner, rest, (*keys, str(key)))
    elif isinstance(value, dict) and first in value:
        yield from found(value[first], rest, keys)


def title_of(row: Row) -> str:
    return str(next((row[key] for key in ("scene", "name", "sweeps") if key in row), ""))


def value_of(row: Row, column: Column) -> Any:
    """A cell: what a function says of a row, or the value at a path; None where that is not there."""
    if not isinstance(column, str):
        return column(row)
    value: Any = row
    for part in column.split("/"):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *([cell(v) for v in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


# --- figures that columns of groups show ------------------------------------------------------------------------------


def count(test: Callable[[Row], Any] | str = "") -> Callable[[list[Row]], int]:
    """Of rows that pass a test, or of which the entry of a key holds; without one, of all."""
    if isinstance(test, str):
        return lambda rows: sum(bool(row.get(test)) for row in rows) if test else len(rows)
    return lambda rows: sum(bool(test(row)) for row in rows)


def most(key: str) -> Callable[[list[Row]], Any]:
    return lambda rows: max((row[key] for row in rows if isinstance(row.get(key), (int, float))), default=None)


def median(key: str) -> Callable[[list[Row]], Any]:
    return lambda rows: (sorted(row[key] for row in rows if isinstance(row.get(key), (int, float))) or [None])[
        sum(isinstance(row.get(key), (int, float)) for row in rows) // 2]  # fmt: skip


def times(key: str, factor: float) -> Callable[[Row], Any]:
    """An entry in another unit."""

    def shown(row: Row) -> Any:
        value = value_of(row, key)
        return factor * value if isinstance(value, (int, float)) else value

    return shown


# --- pages ------------------------------------------------------------------------------------------------------------


def machine(environment: Row) -> str:
    """One line on where and with what a benchmark ran."""
    e = {key: value for key, value in environment.items() if value is not None}
    cuda = e.get("device", "cpu") != "cpu"
    where = f"{place(e)}, driver {e.get('driver', 'unknown')}" if cuda else f"{place(e)}, {e.get('cores', '?')} cores"
    versions = ", ".join(f"{key} {e[key]}" for key in ("python", "torch", "cuda", "diffvbd") if key in e)
    return f"{where}; {versions}; {e.get('date', 'no date')}; commit {commit(e)}."


def harvest(results: Path = RESULTS) -> list[tuple[str, str, dict[str, Any]]]:
    """(benchmark, file without its ending, content) of each result of a present benchmark, the CPU's before a GPU's."""
    out = []
    for path in sorted(results.glob("*.json"), key=lambda path: path.stem):
        content = json.loads(path.read_text(encoding="utf-8"))
        name = content.get("name")
        if name and "results" in content and (Path(__file__).parent / f"{name}.py").exists():
            out.append((name, path.stem, content))
    return out


def pages(results: Path = RESULTS) -> dict[str, str]:
    """A page of Markdown for each benchmark that has results in a folder."""
    out: dict[str, list[str]] = {}
    for name, stem, content in harvest(results):
        module = importlib.import_module(f"bench.{name}")
        about = inspect.cleandoc(module.__doc__ or "")
        out.setdefault(name, [f"# {name}\n\n{about}\n\n`python -m bench {name}` measures it.\n"])
        try:
            tables = text_of(name, content["results"])
        except (KeyError, TypeError) as error:
            raise ValueError(f"{stem}.json: expected results of the present bench.{name}, got older ones; run it "
                             "again") from error  # fmt: skip
        out[name].append(f"## {stem}\n\n{machine(content['environment'])}{measured(content['results'])}\n")
        out[name].append(tables.replace("## ", "### ").replace("####", "###"))
    texts = {name: "\n".join(parts).rstrip() + "\n" for name, parts in out.items()}
    tasks = importlib.import_module("bench.tasks")
    return texts | {"tasks": tasks.page(results / "tasks", tasks.IMAGES, ROOT / "docs")}


def measured(groups: Any) -> str:
    """At which commit each group was measured, if not all were at once."""
    at: dict[str, list[str]] = {}
    for name, group in (groups if isinstance(groups, dict) else {}).items():
        if isinstance(group, dict) and "commit" in group:
            at.setdefault(f"{(group.get('date') or '')[:10]} at {commit(group)}", []).append(name)
    return (
        " Groups: " + "; ".join(f"{', '.join(names)} {when}" for when, names in at.items()) + "." if len(at) > 1 else ""
    )


def write_pages(folder: Path, results: Path = RESULTS) -> list[str]:
    """Writes the pages that have changed, removes those of results that are gone, and returns the names."""
    folder.mkdir(parents=True, exist_ok=True)
    made = pages(results)
    for page in folder.glob("*.md"):
        if page.stem not in made:
            page.unlink()
    for name, text in made.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return list(made)
