"""One method in a process of its own, which answers a line of JSON with a line of JSON.

{"do": "open", "method", "count", "parameters", "unit"} -> {"version"}
{"do": "time", "task", "repeats"}                       -> {"seconds": [...]}
{"do": "check"}                                         -> {"information", "slopes"}
"""

import importlib
import json
import os
import sys
import time


def main() -> None:
    cores = int(sys.argv[1])
    if cores == 1 and hasattr(os, "sched_setaffinity"):
        # Before any library counts the cores: thread pools take their size from this.
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})
    replies = os.fdopen(os.dup(1), "w")
    # What packages print must not get between the replies.
    os.dup2(2, 1)
    problem, tasks = None, {}
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            if asked["do"] == "open":
                from peers.problem import make_problem

                problem = make_problem(asked["count"], asked["parameters"], asked["unit"])
                tasks = importlib.import_module(f"peers.{asked['method']}").build(problem)
                reply = {"version": tasks["version"], "gradient runs": tasks.get("gradient runs")}
            elif asked["do"] == "time":
                reply = {"seconds": [_timed(tasks[asked["task"]]) for _ in range(asked["repeats"])]}
            elif asked["do"] == "check":
                reply = _checked(problem, tasks)
            else:
                # A case with a life of its own: the whole prediction.
                reply = getattr(importlib.import_module(f"peers.{asked['method']}"), asked["do"])(asked)
        except ImportError as error:
            reply = {"absent": str(error)}
        print(json.dumps(reply), file=replies, flush=True)


def _timed(task) -> float:
    begin = time.perf_counter()
    task()
    return time.perf_counter() - begin


def _checked(problem, tasks) -> dict:
    import numpy as np

    from peers.problem import slopes_of

    reply = {"information": np.asarray(tasks["forward"]()).tolist(), "slopes": None}
    if "gradient" in tasks:
        _, gradient = tasks["gradient"]()
        reply["slopes"] = slopes_of([np.asarray(g) for g in gradient], problem).tolist()
    return reply


if __name__ == "__main__":
    sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    main()
