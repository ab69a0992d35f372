"""Conversion of an accepted reply to the neutral model."""

from collections.abc import Mapping
from typing import Final

from ..model import UNKNOWN_PHASES, Phases
from ..readings import ChargerInfo, ConnectorReading
from .frames import ModuleReply, Reply
from .plausibility import AcceptedReply

CHARGING_CURRENT: Final = 0.5
"""A module charges when a phase carries this much, A: the wire has no state, a car
draws 6 A or more, and a box and a sleeping car draw some tenths."""


def serial_number(reply: Reply) -> str | None:
    """Return the serial number without leading zeros; ``None``: not reported."""
    if reply.serial is None:
        return None
    return reply.serial.lstrip("0") or None


def same_serial(one: str, two: str) -> bool:
    """Return whether two serial numbers are the same, however they are padded."""
    return one.strip().lstrip("0") == two.strip().lstrip("0")


def charger_info(serial: str | None) -> ChargerInfo:
    """Return the identity of a ChargePoint: at most its serial number is reported."""
    return ChargerInfo(manufacturer="EVBox", model="ChargePoint", serial=serial)


def connectors(
    accepted: AcceptedReply, voltage: float
) -> Mapping[int, ConnectorReading]:
    """Return the reading of each module, by its number from 1.

    ``voltage``, V: for estimates where the wire has none (69).
    """
    return {
        number: _connector(module, total, generation, voltage)
        for number, (module, total, generation) in enumerate(
            zip(
                accepted.reply.modules,
                accepted.totals,
                accepted.generations,
                strict=True,
            ),
            1,
        )
    }


def _connector(
    module: ModuleReply, total: float | None, generation: int, voltage: float
) -> ConnectorReading:
    estimated = None
    if module.voltages is None:
        estimated = _power(module, (voltage, voltage, voltage))
    voltages = _voltages(module)
    return ConnectorReading(
        charging=max(module.currents) >= CHARGING_CURRENT,
        current=module.currents,
        voltage=voltages,
        cos_phi=module.cos_phi,
        power=_power(module, voltages),
        energy=total,
        meter_generation=generation,
        estimated_power=estimated,
        minimum_current=module.minimum_current,
    )


def _voltages(module: ModuleReply) -> Phases[float | None]:
    """Return measured voltages, V; 0 V on a phase in use means not measured."""
    if module.voltages is None or not any(module.voltages):
        return UNKNOWN_PHASES
    one, two, three = (
        None if voltage == 0 and current >= CHARGING_CURRENT else voltage
        for voltage, current in zip(module.voltages, module.currents, strict=True)
    )
    return one, two, three


def _power(module: ModuleReply, voltages: Phases[float | None]) -> float | None:
    """Return the sum of U * I * cos phi, W; ``None``: a voltage is unknown.

    A phase without current adds nothing, whatever its voltage. The sign of cos phi
    is that of the phase shift; it does not mean that a car feeds back.
    """
    power = 0.0
    for voltage, current, cos_phi in zip(
        voltages, module.currents, module.cos_phi, strict=True
    ):
        if not current:
            continue
        if voltage is None:
            return None
        power += voltage * current * abs(cos_phi)
    return round(power, 1)
