"""The doubles in a process of their own, and the hand that reaches into it."""
