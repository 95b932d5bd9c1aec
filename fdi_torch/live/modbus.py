"""Modbus TCP: polling of the registers of a rig. Only this file imports pymodbus (extra `modbus`)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fdi_torch.live.values import Address, Item, Value
from fdi_torch.names import unknown
from fdi_torch.tables import needed

WordOrder = Literal["big", "little"]
TABLES = {
    "coil": "read_coils",
    "discrete": "read_discrete_inputs",
    "input": "read_input_registers",
    "holding": "read_holding_registers",
}
TYPES = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "int64": 4, "uint64": 4, "float32": 2, "float64": 4}
"""Number of registers of each type."""
MOST_REGISTERS = 125
"""Registers of one request (Modbus application protocol, V1.1b3, 6.3)."""
TIMEOUT = 1.0
"""Time within which a device must answer, s."""
FIRST_RETRY, LONGEST_RETRY = 0.5, 30.0
"""Waiting times between attempts to connect, s; doubled after each."""


@dataclass(frozen=True, order=True)
class Register:
    """A value in the tables of a device. table: key of TABLES; type: key of TYPES, or bit."""

    table: str
    address: int
    type: str

    @property
    def length(self) -> int:
        return TYPES.get(self.type, 1)


def register_of(tag: str) -> Register:
    """'holding:100:float32' as a register; without a type, uint16. Raises ValueError for any other text."""
    table, _, rest = tag.partition(":")
    number, _, kind = rest.partition(":")
    if table not in TABLES:
        raise ValueError(f"{tag}: {unknown('a table of the device', table, TABLES)}")
    if not (number.isascii() and number.isdigit() and int(number) < 2**16):
        raise ValueError(f"{tag}: expected an address from 0 to 65535, as in {table}:100, got '{number}'")
    if table in ("coil", "discrete"):
        if kind:
            raise ValueError(f"{tag}: expected no type for a single bit, got '{kind}'; leave it out")
        return Register(table, int(number), "bit")
    if kind and kind not in TYPES:
        raise ValueError(f"{tag}: {unknown('a type', kind, TYPES)}")
    return Register(table, int(number), kind or "uint16")


def blocks(registers: Sequence[Register]) -> Iterator[list[Register]]:
    """Registers that lie side by side, each block for one request. Holes are not read, as devices may refuse them."""
    block: list[Register] = []
    for register in sorted(set(registers)):
        is_next = block and register.table == block[-1].table
        is_next = is_next and register.address <= block[-1].address + block[-1].length
        if is_next and register.address + register.length - block[0].address <= MOST_REGISTERS:
            block.append(register)
            continue
        if block:
            yield block
        block = [register]
    if block:
        yield block


class ModbusSource:
    """Values of registers, polled each `period` s, as a Connection.

    clock: register with the time, in units of `second` s; None: the time of polling. A sample with the time of the last
    one is repeated. dated: whether the register counts from 1970. device: unit identifier.
    """

    def __init__(
        self,
        address: Address,
        tags: Sequence[str],
        period: float,
        clock: str | None = None,
        second: float = 1.0,
        dated: bool = False,
        device: int = 1,
        word_order: WordOrder = "big",
    ) -> None:
        library = needed("pymodbus.client", "modbus")
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # losses are reported as events
        self.dated = dated or clock is None
        self._registers = {tag: register_of(tag) for tag in tags}
        self._clock = None if clock is None else register_of(clock)
        self._blocks = list(blocks([*self._registers.values(), *([] if self._clock is None else [self._clock])]))
        self._period, self._second, self._device, self._word_order = period, second, device, word_order
        self._client = library.ModbusTcpClient(address.host, port=address.port, timeout=TIMEOUT, retries=1)
        self._place, self._retry, self._lost_at = address.place, FIRST_RETRY, -1.0
        self._start, self._due = time.time() - time.monotonic(), time.monotonic()
        try:
            self._poll()  # a device that answers nothing useful is refused at once
        except (ConnectionError, ValueError) as error:
            self._client.close()
            raise ValueError(f"expected a Modbus device with these registers at {self._place}, got: {error}") from None

    def read(self, timeout: float) -> list[Item]:
        wait = self._due - time.monotonic()
        if wait > 0.0:
            time.sleep(min(wait, timeout))
            return []
        planned, self._due = self._due, max(self._due + self._period, time.monotonic())
        try:
            numbers = self._poll()
        except (ConnectionError, ValueError) as error:
            return self._failed(str(error))
        items: list[Item] = []
        if self._lost_at >= 0.0:
            items.append(f"connected to {self._place} again after {time.monotonic() - self._lost_at:.1f} s")
            self._lost_at, self._retry = -1.0, FIRST_RETRY
        # Planned times are evenly spaced; the answer comes some milliseconds later.
        stamp = self._start + planned if self._clock is None else numbers[self._clock] * self._second
        return [*items, *(Value(tag, stamp, numbers[register]) for tag, register in self._registers.items())]

    def close(self) -> None:
        self._client.close()

    def _failed(self, error: str) -> list[Item]:
        self._client.close()
        self._due = time.monotonic() + self._retry
        self._retry = min(2.0 * self._retry, LONGEST_RETRY)
        if self._lost_at >= 0.0:
            return []
        self._lost_at = time.monotonic()
        return [f"connection to {self._place} lost ({error}); trying again"]

    def _poll(self) -> dict[Register, float]:
        """All registers. Raises ConnectionError without an answer, and ValueError for a refusal by the device."""
        numbers: dict[Register, float] = {}
        for block in self._blocks:
            first, end = block[0].address, max(r.address + r.length for r in block)
            content = self._request(block[0].table, first, end - first)
            for register in block:
                part = content[register.address - first : register.address - first + register.length]
                numbers[register] = self._number(register, part)
        return numbers

    def _request(self, table: str, first: int, count: int) -> Sequence[int]:
        errors = needed("pymodbus.exceptions", "modbus")
        if not self._client.connected and not self._client.connect():
            raise ConnectionError("no connection")
        try:
            answer = getattr(self._client, TABLES[table])(first, count=count, device_id=self._device)
        except errors.ModbusException as error:
            raise ConnectionError(str(error)) from None
        if answer.isError():
            raise ValueError(f"{table}:{first} to {first + count - 1}: {answer}")
        return list(answer.bits[:count] if table in ("coil", "discrete") else answer.registers)

    def _number(self, register: Register, content: Sequence[Any]) -> float:
        if register.type == "bit":
            return float(content[0])
        kind = getattr(self._client.DATATYPE, register.type.upper())
        number = float(self._client.convert_from_registers(list(content), kind, word_order=self._word_order))
        return number if math.isfinite(number) else math.nan
