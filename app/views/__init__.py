"""What the window shows, made in other processes: plans, runs, diagnoses; free of Qt."""
