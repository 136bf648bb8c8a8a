"""A capsule robot with an inner mass: the robot itself, the abilities of its actuator, and how it is driven."""

from collections.abc import Mapping
from math import sqrt
from typing import Self

from pydantic import Field, model_validator

from dragrig.config.settings import Settings, suggestion
from dragrig.config.specimen import Capsule


class RobotDrive(Settings):
    """Relative motion of the inner mass: +slow, −fast, −fast, +slow, and a pause; periodic."""

    slow_mm_s2: float = Field(gt=0, le=1e7)
    """Relative acceleration of the first and the last phase, whose reaction pushes the housing backwards."""
    fast_mm_s2: float = Field(gt=0, le=1e7)
    """Relative deceleration and return of the phases between, whose reaction pushes the housing forwards."""
    stroke_mm: float = Field(gt=0, le=100)
    """Way of the inner mass in the housing."""
    pause_s: float = Field(default=0.0, ge=0, le=60)
    """Rest at the end of a period."""

    @property
    def peak_speed_mm_s(self) -> float:
        """Relative speed u between slow and fast: stroke = u²/2 (1/slow + 1/fast)."""
        return sqrt(2 * self.stroke_mm / (1 / self.slow_mm_s2 + 1 / self.fast_mm_s2))

    @property
    def phases(self) -> tuple[tuple[float, float], ...]:
        """Duration [s] and relative acceleration [mm/s²] of each phase, the pause included."""
        slow_s, fast_s = self.peak_speed_mm_s / self.slow_mm_s2, self.peak_speed_mm_s / self.fast_mm_s2
        strokes = (
            (slow_s, self.slow_mm_s2),
            (fast_s, -self.fast_mm_s2),
            (fast_s, -self.fast_mm_s2),
            (slow_s, self.slow_mm_s2),
        )
        return (*strokes, (self.pause_s, 0.0)) if self.pause_s > 0 else strokes

    @property
    def period_s(self) -> float:
        """Length of a period."""
        return sum(duration for duration, _ in self.phases)


class RobotSettings(Settings):
    """A capsule robot and the limits of its actuator; `ranges` are those of the assumptions."""

    name: str = Field(min_length=1)
    housing_g: float = Field(gt=0, le=1000)
    """Mass M of the housing."""
    inner_mass_g: float = Field(gt=0, le=1000)
    """Mass m that the actuator moves."""
    diameter_mm: float = Field(gt=0, le=100)
    length_mm: float = Field(gt=0, le=200)
    """Of its cylinder."""
    contact_angle_deg: float = Field(default=60.0, gt=0, lt=90)
    """The friction model's α."""
    insertion_dwell_s: float = Field(default=60.0, ge=0, le=1e6)
    """How long it has been in the gut when it starts."""
    hard_friction_coefficient: float = Field(gt=0, le=2)
    """μ on the hard surface."""
    max_force_mN: float = Field(gt=0, le=1e6)
    """Greatest force of the actuator on the inner mass with the housing held."""
    max_stroke_mm: float = Field(gt=0, le=100)
    max_relative_speed_mm_s: float = Field(gt=0, le=1e5)
    """Greatest speed of the inner mass in the housing."""
    max_pause_s: float = Field(default=0.2, ge=0, le=60)
    ranges: Mapping[str, tuple[float, float]] = {}
    """Least and greatest plausible value of what is assumed, by key."""

    @model_validator(mode="after")
    def _ranges_hold_the_values(self) -> Self:
        known = [key for key in type(self).model_fields if key not in {"name", "ranges"}]
        for key, (low, high) in self.ranges.items():
            if key not in known:
                raise ValueError(f"ranges has {key}, which is not a key of a robot; {suggestion(key, known)}")
            value = getattr(self, key)
            if not low <= value <= high or low == high:
                raise ValueError(f"ranges.{key} is {low:g} to {high:g} and does not hold {key} = {value:g}")
            if low <= 0:
                raise ValueError(f"ranges.{key} begins at {low:g}; it must be above 0")
        return self

    @property
    def mass_g(self) -> float:
        """Total mass."""
        return self.housing_g + self.inner_mass_g

    @property
    def max_acceleration_mm_s2(self) -> float:
        """Greatest relative acceleration: mN over g is m/s²."""
        return 1e3 * self.max_force_mN / self.inner_mass_g

    @property
    def capsule(self) -> Capsule:
        """The robot as the friction model sees it."""
        return Capsule(
            name=self.name,
            surface="smooth",
            diameter_mm=self.diameter_mm,
            length_mm=self.length_mm,
            mass_g=self.mass_g,
            contact_angle_deg=self.contact_angle_deg,
        )

    def why_not(self, drive: RobotDrive) -> str:
        """Return which limit of the actuator a drive exceeds; empty where none."""
        limits = (
            ("slow_mm_s2", drive.slow_mm_s2, self.max_acceleration_mm_s2, "mm/s²"),
            ("fast_mm_s2", drive.fast_mm_s2, self.max_acceleration_mm_s2, "mm/s²"),
            ("stroke_mm", drive.stroke_mm, self.max_stroke_mm, "mm"),
            ("the relative speed", drive.peak_speed_mm_s, self.max_relative_speed_mm_s, "mm/s"),
        )
        for name, value, limit, unit in limits:
            if value > limit * (1 + 1e-9):
                return f"{name} is {value:.4g} {unit}, and the actuator of robot {self.name} reaches {limit:.4g} {unit}"
        return ""
