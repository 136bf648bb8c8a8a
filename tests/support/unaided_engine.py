"""Imported by the process that engines are forked of: they finish run files themselves.

As they do wherever no process can be started for that; to start one takes longer than a quick session itself.
"""

import sys

sys.executable = "no interpreter"
