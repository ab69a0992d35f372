"""Virtual chargers on a virtual RS-485 bus: the independent oracle of the tests.

Written from the manuals alone; nothing here imports the integration. Example::

    from tests.virtual import AblBox, Car, VirtualBus, requests_in

    car = Car(max_current=16)
    box = AblBox(1, car=car)
    with VirtualBus.pty(box, time_scale=10) as bus:   # or VirtualBus.tcp(box)
        client = open_my_client(bus.url)              # a path, or socket://127.0.0.1:n
        car.plug_in()
        bus.wait_for(lambda: box.state == "C2")       # or: await bus.wait_for_async(...)
        box.faults.once("lose")                       # the next reply is lost
        bus.unplug(); bus.replug()                    # the adapter
        assert all(r.register != 0x05 for r in requests_in(bus.log.bursts()))
"""

from .abl import AblBox, Write
from .abl_frames import Request, amps_of, duty_of, requests_in
from .abl_outlet import Outlet
from .bus import VirtualBus
from .car import Car, CarLife
from .device import Device
from .evbox import EvboxChargePoint, Module
from .evbox_frames import Order, orders_in, requests_without_silence
from .ews_box import EwsBox
from .ews_dialler import EwsDialler
from .ews_frames import ews_commands_in
from .ews_port import EwsPort
from .ews_records import EwsCommand, EwsInfo, EwsLimit, InfoMix
from .ews_rfid import Card as EwsCard
from .faults import Faults
from .log import CLIENT, Entry, TrafficLog
from .smartevse import SmartEvse
from .smartevse_controller import SmartEvseController
from .smartevse_frames import SmartEvseRequest, smartevse_requests_in
from .smartevse_history import BalanceBroadcast, Handshake, RegisterWrite

__all__ = [
    "CLIENT",
    "AblBox",
    "BalanceBroadcast",
    "Car",
    "CarLife",
    "Device",
    "Entry",
    "EvboxChargePoint",
    "EwsBox",
    "EwsCard",
    "EwsCommand",
    "EwsDialler",
    "EwsInfo",
    "EwsLimit",
    "EwsPort",
    "Faults",
    "Handshake",
    "InfoMix",
    "Module",
    "Order",
    "Outlet",
    "RegisterWrite",
    "Request",
    "SmartEvse",
    "SmartEvseController",
    "SmartEvseRequest",
    "TrafficLog",
    "VirtualBus",
    "Write",
    "amps_of",
    "duty_of",
    "ews_commands_in",
    "orders_in",
    "requests_in",
    "requests_without_silence",
    "smartevse_requests_in",
]
