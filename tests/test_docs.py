"""What the documentation shows does what it says."""

import asyncio
from pathlib import Path
import re
import sys

from custom_components.evse_bus.evse.protocols import PROTOCOLS
from custom_components.evse_bus.flow_schema import default_of
from tests.virtual import AblBox, Car, VirtualBus

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "custom_components/evse_bus"


def script(page: str) -> str:
    """Return the one Python block of a page."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    return block


def test_the_readme_knows_how_often_is_asked() -> None:
    every = {
        key: f"{default_of(PROTOCOLS[key], 'poll_interval'):g} s"
        for key in ("evbox", "abl", "smartevse", "smartevse_master")
    }
    assert every["abl"] == every["smartevse"] == every["smartevse_master"]
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert f"EVBox {every['evbox']}, ABL and SmartEVSE {every['abl']}" in readme
    assert f"an EVBox every {every['evbox']}" in readme
    assert f"an ABL box or a SmartEVSE every {every['abl']}" in readme


async def test_the_script_of_the_library_reads_and_sets_a_charger() -> None:
    code = script("docs/library.md")
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) == 12
    car = Car(max_current=16)
    box = AblBox(1, car=car)
    async with VirtualBus.pty(box) as bus:
        car.plug_in()
        await bus.wait_for_async(lambda: box.state == "C2", timeout=10)
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            # As on a machine that has never heard of Home Assistant.
            "import sys; sys.modules['homeassistant'] = None\n" + code,
            bus.url,
            cwd=LIBRARY,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        async with asyncio.timeout(30):
            out, err = await process.communicate()
        assert process.returncode == 0, err.decode()
        assert "raw_state='C2'" in out.decode()
        assert box.limits_written == [166]
        assert box.ic_amps <= 10.0
