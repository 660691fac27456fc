"""Build all C with sanitizers for addresses and undefined behaviour, and run what uses it.

python tools/sanitize.py             the tests of the packages with C
python tools/sanitize.py tests/...   some tests only
python tools/sanitize.py --short     a batch, a distance, a plan and an update instead of the tests

Needs gcc with its libraries libasan and libubsan. A report ends the process that it is about. Tests that
fail for other reasons, such as searches for which sanitized code is too slow, do not count.
"""

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("compilation", "geometry", "planning", "estimation", "control")
REPORTED = 86
"""Status of a process that ends with a report; one about undefined behaviour may be printed."""

# What is compiled once and run once is compiled faster than it is optimised.
COMPILER = """#!/bin/sh
for argument; do
    shift
    case "$argument" in -O2 | -O3) argument=LEVEL ;; esac
    set -- "$@" "$argument"
done
exec gcc -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g1 "$@"
"""

# CasADi asks for symbols of its own first, which the library of the sanitizer refuses. Libraries are opened
# by descriptors, and reports have functions and lines of those only that are opened by paths.
PRELOADED = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <limits.h>
#include <string.h>
#include <unistd.h>
void *dlopen(const char *path, int flags) {
  void *(*next)(const char *, int) = (void *(*)(const char *, int))dlsym(RTLD_NEXT, "dlopen");
  char file[PATH_MAX] = "";
  if (path && !strncmp(path, "/proc/self/fd/", 14) && readlink(path, file, sizeof file - 1) > 0 &&
      !access(file, R_OK))
    path = file;
  return next(path, flags & ~RTLD_DEEPBIND);
}
"""


def find_libraries() -> list[str] | None:
    """Return the paths of gcc's libraries for sanitizers, or None."""
    if shutil.which("gcc") is None or not sys.platform.startswith("linux"):
        return None
    found = []
    for name in ("libasan.so", "libubsan.so"):
        path = subprocess.run(
            ["gcc", f"-print-file-name={name}"], capture_output=True, text=True, encoding="utf-8"
        ).stdout.strip()
        if not os.path.isabs(path):
            return None
        found.append(path)
    return found


def environment(folder: Path, libraries: list[str], level: str = "-Og") -> dict[str, str]:
    """Return an environment in which all C is built with sanitizers at a level, with files in a folder."""
    compiler, preloaded = folder / "sanitizing-gcc", folder / "preloaded.so"
    report = f"log_path={folder}/report"
    compiler.write_text(COMPILER.replace("LEVEL", level), encoding="utf-8")
    compiler.chmod(compiler.stat().st_mode | stat.S_IXUSR)
    build = ["gcc", "-shared", "-fPIC", "-x", "c", "-", "-o", str(preloaded)]
    subprocess.run(build, input=PRELOADED, text=True, encoding="utf-8", check=True)
    source = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH"))))
    return {
        **os.environ,
        "PYTHONPATH": source,
        "CC": str(compiler),
        "KINEVERSE_CACHE_DIR": str(folder / "cache"),
        "LD_PRELOAD": ":".join([str(preloaded), *libraries]),
        # Python keeps memory until it ends, and preloaded.so comes before the sanitizer.
        "ASAN_OPTIONS": "detect_leaks=0:verify_asan_link_order=0:allocator_may_return_null=1:"
        f"exitcode={REPORTED}:{report}",
        "UBSAN_OPTIONS": f"print_stacktrace=1:exitcode={REPORTED}:{report}",
        # Arrays have an end of their own each.
        "PYTHONMALLOC": "malloc",
    }


def run_short() -> None:
    """Compute a bit of everything; for a process in the environment."""
    import numpy as np

    import kineverse as kv
    from kineverse.model.body import Body, Box, Capsule, Shape, Sphere

    symbols = [kv.position(name) for name in "xyz"]
    for inputs in (1, 2, 3):
        f = kv.compile(sum(symbols[:inputs], kv.expressions.array(0.0)), symbols[:inputs], tier="c")
        for rows in (0, 1, *range(8, 24)):
            points = np.arange(float(rows * inputs)).reshape(rows, inputs)
            assert np.array_equal(f.batch(points), points.sum(axis=1))

    model, (x, y, _) = kv.Model(), symbols
    with model.edit() as edit:
        shapes = (Box((0.1, 0.2, 0.1)), Capsule(0.05, 0.2), Sphere(0.05))
        pose = kv.translation(x, y, 0)
        edit.add_frame("hand", "world", pose, Body(collisions=tuple(map(Shape, shapes))))
        for k in range(9):
            edit.add_frame(
                f"post{k}", "world", kv.translation(0, k - 4, 0), Body(collisions=(Shape(shapes[k % 3]),))
            )
        edit.constrain("x", -2, x, 2)
        edit.constrain("y", -5, y, 5)
    scene = kv.geometry.Scene(model)
    scene.update({"x": -1.0, "y": 0.0})
    assert 0.5 < scene.distance("hand", "post4").distance < 1.0

    planner = kv.planning.Planner(model)
    path = planner.plan([-1.0, 0.0], [1.0, 0.0], seconds=30.0)
    assert path, path.why
    assert path.clearance() > 0.0

    tracker = kv.estimation.Tracker(model, ["hand"], start={"x": 0.1, "y": 0.1}, outliers=True)
    tracker.wait()
    for _ in range(3):
        tracker.update({"hand": np.array(kv.translation(0.2, 0.1, 0)())})
    assert abs(tracker.estimate.state[x] - 0.2) < 0.05

    controller = kv.control.Controller(model, [kv.control.Goal(x, 1.0)], scene=scene, dt=0.02)
    controller.wait()
    controller.step({"x": 0.3, "y": 0.5})


def main(arguments: list[str]) -> int:
    """Run the command line and return its status."""
    libraries = find_libraries()
    if libraries is None:
        print(
            "Sanitizers need gcc with libasan and libubsan, on Linux: install gcc, or the package libgcc-dev."
        )
        return 2
    short = arguments == ["--short"]
    with tempfile.TemporaryDirectory(prefix="kineverse-sanitizers-") as name:
        # Reports are printed below the streams of Python.
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "--assert=plain",
            "--capture=sys",
            "-p",
            "no:cacheprovider",
        ]
        # Decomposition limits the memory of a process without C of ours; sanitizers need more than that.
        command += ["--ignore-glob=*decompos*"]
        command += arguments or [str(ROOT / "tests" / package) for package in PACKAGES]
        if short:
            command = [sys.executable, __file__, "--inside"]
        inside = environment(Path(name), libraries, "-O0" if short else "-Og")
        status = subprocess.run(command, env=inside, cwd=ROOT).returncode
        reports = [
            path.read_text(encoding="utf-8", errors="replace") for path in sorted(Path(name).glob("report.*"))
        ]
    print(*reports, sep="\n")
    print(f"{len(reports)} reports of sanitizers.")
    # 1: some tests have failed, by themselves.
    ended = status not in ((0,) if short else (0, 1))
    if ended:
        print(f"The tests ended before their end, with status {status}: the last report is above.")
    return int(bool(reports) or ended)


if __name__ == "__main__":
    if sys.argv[1:] == ["--inside"]:
        run_short()
    else:
        sys.exit(main(sys.argv[1:]))
