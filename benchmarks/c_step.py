"""Step of an exported law compared with a matrix product of its size, both in C.

``python -m benchmarks.c_step`` exports an integral law that estimates the bias of its gyroscope and
knows the delay of its loop. It prints the ratio of the instructions of a step to those of a bare
product of the matrix [A B; C D] of the law with a vector, and the ratio of their CPU times. It
needs a C compiler, and valgrind for the instructions.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import fflin
from benchmarks.instructions import total

FLAGS = ["-std=c99", "-O2", "-ffp-contract=off"]
SAMPLE, DELAY = 0.25, 0.25  # [s]
# Calls that are counted, calls that are timed, and repetitions of which the shortest counts.
COUNTED, TIMED, ROUNDS = 2_000, 300_000, 9

# The program calls the step or the product, as its first argument says, and prints the CPU time.
MAIN = """
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "controller.h"
#define ROWS (CONTROLLER_MEMORY + CONTROLLER_INPUTS)
#define COLUMNS (CONTROLLER_MEMORY + CONTROLLER_OUTPUTS)
void product(const double x[COLUMNS], double result[ROWS]);

int main(int count, char **arguments)
{
    const int steps = arguments[1][0] == 's';
    const long calls = count > 2 ? atol(arguments[2]) : 1;
    double y[CONTROLLER_OUTPUTS] = {0}, u[CONTROLLER_INPUTS];
    double x[COLUMNS] = {0}, result[ROWS], sum = 0;
    controller_memory memory;
    clock_t start;
    long k;

    controller_start(&memory);
    start = clock();
    for (k = 0; k < calls; k++) {
        if (steps) {
            y[0] = 1e-6 * (double)(k % 7);
            controller_step(&memory, y, u);
            sum += u[0];
        } else {
            x[0] = 1e-6 * (double)(k % 7);
            product(x, result);
            sum += result[0];
        }
    }
    printf("%.9g %.9g\\n", (double)(clock() - start) / CLOCKS_PER_SEC, sum);
    return 0;
}
"""

PRODUCT = """
#include "controller.h"
#define ROWS (CONTROLLER_MEMORY + CONTROLLER_INPUTS)
#define COLUMNS (CONTROLLER_MEMORY + CONTROLLER_OUTPUTS)
static const double matrix[ROWS][COLUMNS] = {%s};

void product(const double x[COLUMNS], double result[ROWS])
{
    int i, j;
    for (i = 0; i < ROWS; i++) {
        double sum = 0;
        for (j = 0; j < COLUMNS; j++) {
            sum += matrix[i][j] * x[j];
        }
        result[i] = sum;
    }
}
"""


def law() -> fflin.OutputFeedback:
    """Return an integral law of attitude and rate that estimates the bias of its gyroscope."""
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(max=1e-3)],
        outputs=[fflin.StarTracker(), fflin.Gyroscope("base")],
    )
    model = fflin.linearize(robot).discretize(SAMPLE, delay=DELAY)
    gain = fflin.lqr(model, integral_action=["q_b"])
    estimator = fflin.kalman(
        model,
        {"omega_b": 1e-9},
        {"q_b": 1e-10, "gyroscope": 1e-12},
        bias_noise={"gyroscope": 1e-16},
    )
    return fflin.OutputFeedback(model, fflin.lqg(gain, estimator))


def program(folder: Path) -> Path:
    """Write and compile the program that calls the step of the law or the product."""
    policy = law()
    fflin.write_c(policy, folder)
    system = policy.linear_law()
    matrix = np.block([[system.A, system.B], [system.C, system.D]])
    rows = [
        "{" + ", ".join(repr(float(value)) for value in row) + "}" for row in matrix
    ]
    (folder / "product.c").write_text(PRODUCT % ",\n".join(rows))
    (folder / "main.c").write_text(MAIN)
    binary = folder / "steps"
    sources = [folder / f"{name}.c" for name in ("main", "product", "controller")]
    subprocess.run(["cc", *FLAGS, "-o", binary, *sources, "-lm"], check=True)
    return binary


def instruction_ratio(binary: Path) -> float:
    """Return the instructions of a step, divided by the instructions of a product."""
    step, product = (_instructions(binary, task) for task in ("step", "product"))
    return step / product


def _instructions(binary: Path, task: str) -> float:
    """Return the instructions of one call; the difference of two runs contains calls alone."""
    counts = []
    for calls in (COUNTED, 2 * COUNTED):
        out = binary.with_name("counts")
        valgrind = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
        subprocess.run(
            [*valgrind, binary, task, str(calls)], check=True, capture_output=True
        )
        counts.append(total(out))
    return (counts[1] - counts[0]) / COUNTED


def time_ratio(binary: Path) -> float:
    """Return the CPU time of a step, divided by the time of a product; they take turns."""
    best = {"step": np.inf, "product": np.inf}
    for _ in range(ROUNDS):
        for task, shortest in best.items():
            done = subprocess.run(
                [binary, task, str(TIMED)], check=True, capture_output=True, text=True
            )
            best[task] = min(shortest, float(done.stdout.split()[0]))
    return best["step"] / best["product"]


def main() -> None:
    """Print the ratios."""
    with tempfile.TemporaryDirectory() as folder:
        binary = program(Path(folder))
        if shutil.which("valgrind"):
            print(f"instructions of a step / product: {instruction_ratio(binary):.3f}")
        else:
            print("instructions: not counted, because valgrind is not installed")
        print(f"CPU time of a step / product:     {time_ratio(binary):.3f}")


if __name__ == "__main__":
    main()
