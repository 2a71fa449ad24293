"""Your device, behind the real protocol, without the device: a session of the bridge with its emulator.

Both run in virtual time: handshake, delay measured, coupling designed and certified for it, armed, run, ramped out.
"""

import numpy as np

from hw.emulator_core import Emulator
from hw.plan import Ages, ladder, link_delay
from hw.rehearsal import Rehearsal
from hw.safety import Limits
from hw.session import Session, Settings
from hw.trace import Recorder
from models.device import RigidDevice
from sim import load

# put your numbers here: [kg], [N s/m], [N], [m]
MINE = RigidDevice(mass=0.18, damping=0.9, force_limit=6.0, encoder_step=2e-6)
SECONDS = 2.0


def main() -> None:
    scenario = load("omega-pair").replace(T=1e-3, theta=(1, 1), device=(MINE, MINE))
    session = Session(scenario, Limits((MINE.force_limit,) * 2), Settings(measure=200))
    session.record = recorder = Recorder(scenario.channels)

    def plan(ages: Ages):  # what the bridge does: the delay that 99 % of the answers keep, with a guard of 0.1 ms
        rungs = ladder(scenario, "I", None, None, link_delay(ages, 1e6 * scenario.T, 0.99, 100.0))
        found = rungs[0].requirements["theorem4"]
        print(f"measured: {ages.quantile(0.5)} us from sample to force; {rungs[0].name}")
        print(f"needs {max(found.required):.4f} of {min(found.available):.2f} N s/m: certified = {found.certified}")
        return rungs

    def stop(session: Session, now: int) -> bytes:
        return session.stop("asked to", now)

    rehearsal = Rehearsal(session, Emulator(scenario), plan, actions=[(SECONDS, stop)])
    rehearsal.run_until_armed(SECONDS + 0.5)
    moved = np.abs(recorder.link()["x"]).max()
    print(f"{len(recorder)} ticks, ended {session.stage}; handles moved up to {1e3 * moved:.1f} mm")
    print(f"zero force {1e3 * (rehearsal.zero_after(SECONDS) or 0.0):.1f} ms after the stop was asked for")


if __name__ == "__main__":
    main()
