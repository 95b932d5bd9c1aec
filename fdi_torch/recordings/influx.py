"""The result of an SQL query to InfluxDB 3 (influxdb3-python, extra `influx`). Its only importer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from urllib.parse import parse_qsl, unquote, urlsplit

from fdi_torch.recordings.parquet import plain_values
from fdi_torch.recordings.table_files import Row
from fdi_torch.tables import needed

PORT = 8181
SECURE = "influxdbs"


def rows(database: str, query: str, inserted: Callable[[str], str]) -> Iterator[Row]:
    """The names of the columns, then the rows.

    database: `influxdb://HOST:PORT/DATABASE?token=${NAME}`, or `influxdbs://...` for an encrypted connection.
    inserted: a text with the values of the environment variables that it names.
    """
    parts = urlsplit(database)
    token = dict(parse_qsl(parts.query)).get("token")
    client = needed("influxdb_client_3", "influx").InfluxDBClient3(
        host=f"{'https' if parts.scheme == SECURE else 'http'}://{parts.hostname}:{parts.port or PORT}",
        database=unquote(parts.path.removeprefix("/")),
        token=inserted(token) if token else None,
    )
    try:
        table = client.query(query, language="sql")
    finally:
        client.close()
    yield table.column_names
    for batch in table.to_batches():
        yield from zip(*(plain_values(column) for column in batch.columns), strict=True)
