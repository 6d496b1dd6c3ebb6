"""What is poured: how the spheres bounce, rub and attract each other."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np


@dataclass(frozen=True)
class Material:
    """The properties that make 100 spheres behave like water, like bouncing balls or like paste.

    Two spheres at distance d within `reach` attract each other with the force attraction / d. The published
    simulator also has a speed below which nothing bounces; contacts in MuJoCo are damped springs, which need
    no such speed, and friction, which here separates the same materials, stands in its place.

    Args:
        bounce: Speed after a collision divided by the speed before it, in [0.05, 0.7].
        friction: Coulomb friction coefficient of all contacts of the spheres, in [0.001, 2].
        attraction: Constant K between spheres of density 1 [length^4 / time^2], in [0, 1e-5].
        reach: Distance up to which spheres attract each other [length], in [0.05, 0.5].

    Raises:
        ValueError: A property lies outside its range.

    Source: Yamaguchi & Atkeson, Differential Dynamic Programming for Graph-Structured Dynamical Systems,
    Humanoids 2016, Section VII.
    """

    bounce: float
    friction: float
    attraction: float
    reach: float

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"material: {name} is {value!r}; give a number from {low} to {high}")

    @property
    def features(self) -> np.ndarray:
        """(4,) what is observed of the material: bounce, friction, attraction in 1e-6, reach."""
        return np.array([self.bounce, self.friction, 1e6 * self.attraction, self.reach])


# Contacts that give back more would let a fast sphere through a wall.
_RANGES = {"bounce": (0.05, 0.7), "friction": (0.001, 2.0), "attraction": (0.0, 1e-5), "reach": (0.05, 0.5)}

# Bounce, attraction and reach are those of the published simulator. With its friction of 0.001 viscous material
# often pours through a mouth of 0.13 in MuJoCo, where contacts do not stick as its softer ones do; 0.35 makes it
# jam reliably.
MATERIALS = {
    "wat": Material(bounce=0.1, friction=0.1, attraction=0.0, reach=0.1),
    "bnc": Material(bounce=0.7, friction=0.1, attraction=0.0, reach=0.1),
    "vsc": Material(bounce=0.1, friction=0.35, attraction=2.5e-7, reach=0.2),
    "vsc+": Material(bounce=0.1, friction=0.35, attraction=1.5e-6, reach=0.1),
}


def find_material(material: str | Material) -> Material:
    """Return the material itself or the one of that name."""
    if isinstance(material, Material):
        return material
    if material not in MATERIALS:
        raise ValueError(f"material: there is no {material!r}; choose from {list(MATERIALS)} or pass a Material")
    return MATERIALS[material]


def mix(first: str | Material, second: str | Material, share: float) -> Material:
    """Return the material between two others, (1 - share) * first + share * second for each property.

    Args:
        first: The material at share 0.
        second: The material at share 1.
        share: How much of the second, in [0, 1].

    Raises:
        ValueError: The share lies outside [0, 1].
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"mix: share is {share!r}; give a number from 0 to 1")
    pairs = zip(astuple(find_material(first)), astuple(find_material(second)), strict=True)
    return Material(*((1.0 - share) * a + share * b for a, b in pairs))
