"""The result of a database query as a table (SQLAlchemy, extra `sql`; influxdb3-python, extra `influx`). The only
importer of both.

A query is one address: `DATABASE?query=SQL`, such as `sqlite:///plant.db?query=SELECT t_s, Q1_cm3_s, h1_cm FROM run`.
The SQL is last and taken as it is written. Passwords stand in environment variables, as `${NAME}`, so that
the address can be shown and logged: the value is inserted for the connection only. An InfluxDB 3 database is
`influxdb://HOST:PORT/DATABASE?token=${NAME}`, or `influxdbs://...` for an encrypted connection.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from fdi_torch.recordings.arrow import plain_values
from fdi_torch.recordings.table_files import Row, tab_separated
from fdi_torch.tables import needed

_ADDRESS = re.compile(r"(?P<database>[A-Za-z][\w+]*://[^?]*(?:\?.*?)?)[?&]query=(?P<query>.*)", re.S)
_VARIABLE = re.compile(r"\$\{(\w+)\}")
_SECRETS = ("password", "passwd", "pwd", "passfile", "sslpassword", "token")
_ROWS_AT_ONCE = 4096
_INFLUX_PORT = 8181
HIDDEN = "***"


def is_query(name: str) -> bool:
    """Whether the name of a recording is the address of a database."""
    return re.match(r"[A-Za-z][\w+]*://", name) is not None


def expect_no_password(address: str) -> None:
    """Raises ValueError, which does not contain the address, if a password is written in it."""
    database = address.partition("query=")[0]
    try:
        parts = urlsplit(database)
        secrets = [parts.password, *(value for key, value in parse_qsl(parts.query) if key.lower() in _SECRETS)]
    except ValueError:
        raise ValueError("expected an address such as postgresql://HOST/DATABASE?query=SQL, got another") from None
    if any(secret and not _VARIABLE.fullmatch(secret) for secret in secrets):
        raise ValueError(
            "expected the password of a database in an environment variable, as in "
            "postgresql://USER:${DB_PASSWORD}@HOST/DATABASE?query=SQL, got a written one; move it there"
        )


def write_query(address: str, target: Path, find: Callable[[str], Path]) -> None:
    """Write the table of a query as tab-separated text. find: returns the path of the SQLite file
    that an address names.

    Raises ValueError, without the values of environment variables, if there is no such database or query.
    """
    expect_no_password(address)
    match = _ADDRESS.fullmatch(address)
    if match is None or not match["query"].strip():
        raise ValueError(f"{address}: expected DATABASE?query=SQL, with the query last, got no query; add it")
    database, values = match["database"], [_value(name, address) for name in _VARIABLE.findall(match["database"])]
    try:
        with target.open("w", encoding="utf-8", newline="") as file:
            for lines in tab_separated(_rows(database, match["query"], find)):
                file.writelines(lines)
    except (MemoryError, ImportError, FileNotFoundError):
        raise
    except Exception as error:  # drivers raise many types, some with the address of the connection in their text
        first = str(error).partition("\n")[0] or type(error).__name__
        for value in values:
            first = first.replace(quote(value, safe=""), HIDDEN).replace(value, HIDDEN)
        raise ValueError(f"{address}: expected a table from this query, got an error: {first}") from None


def _value(name: str, address: str) -> str:
    value = os.environ.get(name, "")
    if not value:
        raise ValueError(f"{address}: expected a value of the environment variable {name}, got none; set it")
    return value


def _rows(database: str, query: str, find: Callable[[str], Path]) -> Iterator[Row]:
    """The names of the columns, then the rows."""
    if database.startswith(("influxdb://", "influxdbs://")):
        yield from _influx_rows(database, query)
        return
    library = needed("sqlalchemy", "sql")
    engine = _engine(library, database, find)
    statement = library.text(query.replace(":", r"\:"))  # a colon is part of a time or a cast, not a parameter
    try:
        with engine.connect() as connection:
            result = connection.execution_options(stream_results=True).execute(statement)
            yield list(result.keys())
            for block in result.partitions(_ROWS_AT_ONCE):
                yield from block
    finally:
        engine.dispose()


def _influx_rows(database: str, query: str) -> Iterator[Row]:
    """As `_rows`, of InfluxDB 3."""
    parts = urlsplit(database)
    token = dict(parse_qsl(parts.query)).get("token")
    client = needed("influxdb_client_3", "influx").InfluxDBClient3(
        host=f"{'https' if parts.scheme == 'influxdbs' else 'http'}://{parts.hostname}:{parts.port or _INFLUX_PORT}",
        database=unquote(parts.path.removeprefix("/")),
        token=_inserted(token) if token else None,
    )
    try:
        table = client.query(query, language="sql")
    finally:
        client.close()
    yield table.column_names
    for batch in table.to_batches():
        yield from zip(*(plain_values(column) for column in batch.columns), strict=True)


def _inserted(text: str, encode: Callable[[str], str] = str) -> str:
    """The text with the values of the environment variables that it names."""
    return _VARIABLE.sub(lambda match: encode(os.environ[match[1]]), text)


def _engine(library: Any, database: str, find: Callable[[str], Path]) -> Any:
    """The connections to a database; an SQLite file is opened for reading only, and never created."""
    scheme, _, rest = database.partition("://")
    if scheme.partition("+")[0] == "sqlite":
        path = find(unquote(rest.partition("?")[0].removeprefix("/"))).resolve()
        return library.create_engine(
            "sqlite://", creator=lambda: sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)
        )
    return library.create_engine(_inserted(database, lambda value: quote(value, safe="")), hide_parameters=True)
