"""`python -m tests.golden`: print this machine's digests beside those in the repository; `--write` replaces them."""

import json
import sys

import torch

from pipelines.workspace.arithmetic import differing
from pipelines.workspace.provenance import host
from tests.golden import FILE, cases, kept

torch.set_num_threads(1)
before = kept() if FILE.exists() else {}
now = {}
for name, run in cases().items():
    now[name] = run()
    print(f"{name:36} {now[name]}  {'as kept' if before.get(name) == now[name] else 'differs'}", flush=True)
print(f"on {host().machine}; operations that differ from the published ones: {', '.join(differing()) or 'none'}")
if "--write" in sys.argv:
    FILE.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
sys.exit(any(before.get(name) != found for name, found in now.items()))
