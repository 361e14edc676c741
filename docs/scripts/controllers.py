"""Make docs/controllers.png from a page of the guide: ``python docs/scripts/controllers.py``."""

import os
import re
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parents[1]
NAMES = ("PD with a direct term", "H-infinity, weighed as an integral")


def main() -> None:
    """Run the code of the page and draw its last two motions."""
    page = (DOCS / "guide" / "controllers.md").read_text(encoding="utf-8")
    toml, *_ = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    code, own = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL)), {}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        Path("stowed.toml").write_text(toml, encoding="utf-8")
        exec(compile(code, "controllers.md", "exec"), own)
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.2), layout="constrained")
    for motion, name in zip(own["motions"], NAMES, strict=True):
        axes[0].semilogy(motion.t, motion.attitude_error, label=name)
        axes[1].plot(motion.t, motion.u[:, 0], label=name)
    for each, title in zip(axes, ("attitude error [deg]", "torque tau_b.x [N m]"), strict=True):
        each.set(title=title, xlabel="time [s]")
        each.grid(color="#dddddd", linewidth=0.6)
        each.legend(frameon=False)
    figure.savefig(DOCS / "controllers.png", dpi=110)


if __name__ == "__main__":
    main()
