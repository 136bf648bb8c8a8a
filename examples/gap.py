"""Is there a gap between a campaign and the friction model, and why? `python examples/gap.py CAMPAIGN`."""

import sys

import dragrig

found = dragrig.gap_diagnose(sys.argv[1])
print(f"{found.verdict}: {', '.join(found.effects) or 'no effect named'}")
for part in found.budget.entries if found.budget else ():
    print(f"{part.cause:24s} {part.share:6.0%} of the gap in the {part.channel}")
if found.next_experiment is not None:
    print(f"next: {found.next_experiment.reason}")
