"""Replies for the tests of plausibility and readings."""

from custom_components.evse_bus.evse.evbox.frames import ModuleReply, Reply


def module(
    *,
    amperes: float = 0.0,
    currents: tuple[float, float, float] | None = None,
    cos_phi: float = 1.0,
    energy: int = 1000,
    minimum: float = 6.0,
    voltages: tuple[float, float, float] | None = (230.0, 230.0, 230.0),
) -> ModuleReply:
    return ModuleReply(
        minimum_current=minimum,
        currents=currents or (amperes, amperes, amperes),
        cos_phi=(cos_phi, cos_phi, cos_phi),
        energy=energy,
        voltages=voltages,
    )


def reply(
    *modules: ModuleReply,
    maximum: float = 35.0,
    interval: int = 1,
    serial: str | None = "01923054",
) -> Reply:
    return Reply(
        command=69 if serial is None else 68,
        serial=serial,
        minimum_interval=interval,
        maximum_current=maximum,
        modules=modules,
    )
