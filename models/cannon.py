"""Two cannons and one target: choose the cannon, aim it, hit soon (the paper's first toy example).

Source: Yamaguchi & Atkeson, Differential Dynamic Programming for Graph-Structured Dynamical Systems,
Humanoids 2016, section IV.
"""

import casadi as ca

import symgraph as sg

GRAVITY = 9.8  # [m/s^2]
SPEED = 3.0  # at the muzzle [m/s]
LOWER_MUZZLE = (0.0, 0.0)  # position [m]
UPPER_MUZZLE = (0.0, 0.8)  # position [m]
TARGET_Y = 0.3  # the paper moves the target along this height [m]
THETA_LIMIT = 1.57  # just inside pi/2, where the bullet would never reach the target's x [rad]
TIME_WEIGHT = 1e-3  # small, because hitting comes before hitting soon [m^2/s^2]


def fly(muzzle: ca.MX, target: ca.MX, speed: ca.MX, theta: ca.MX) -> dict[str, ca.MX]:
    """True ballistics up to the moment when the bullet passes the target's x position.

    hit_time = b / (v cos(theta)) and hit_height = y0 + b tan(theta) - g b^2 / (2 v^2 cos(theta)^2), where
    b = target_x - muzzle_x. The paper's alpha already holds 1 / cos(theta)^2 and is then divided by it again,
    one cos^2 too many; here it appears once, as physics has it.

    Args:
        muzzle: (2,) position [m].
        target: (2,) position [m].
        speed: () at the muzzle [m/s].
        theta: () launch angle above the horizontal [rad].

    Returns:
        hit_time: () [s]; hit_height: () [m].

    Source: Yamaguchi & Atkeson 2016, section IV, with alpha corrected.
    """
    distance = target[0] - muzzle[0]
    hit_time = distance / (speed * ca.cos(theta))
    return {
        "hit_time": hit_time,
        "hit_height": muzzle[1] + distance * ca.tan(theta) - GRAVITY / 2 * hit_time**2,
    }


def score(hit_time: ca.MX, hit_height: ca.MX, target: ca.MX) -> ca.MX:
    """Reward of a shot: R = -(hit_height - target_y)^2 - 1e-3 hit_time^2.

    Args:
        hit_time: () [s].
        hit_height: () [m].
        target: (2,) position [m].

    Returns:
        () reward [m^2].

    Source: Yamaguchi & Atkeson 2016, section IV.
    """
    return -((hit_height - target[1]) ** 2) - TIME_WEIGHT * hit_time**2


def graph() -> sg.Graph:
    """The task: aim, shoot with the lower or the upper cannon, be scored where the bullet passes the target.

    Source: Yamaguchi & Atkeson 2016, figure 2.
    """
    graph = sg.Graph(
        {
            "theta": sg.Action(low=-THETA_LIMIT, high=THETA_LIMIT, unit="rad"),
            "cannon": sg.Selection(["lower", "upper"]),
            "speed": sg.State(unit="m/s"),
            "target": sg.State(2, unit="m"),
            "lower_muzzle": sg.State(2, unit="m"),
            "upper_muzzle": sg.State(2, unit="m"),
            "hit_time": sg.State(unit="s"),
            "hit_height": sg.State(unit="m"),
        },
        start="aim",
    )
    graph.choose(
        "aim",
        "cannon",
        {
            "lower": ("landed", sg.Model(fly, rename={"muzzle": "lower_muzzle"})),
            "upper": ("landed", sg.Model(fly, rename={"muzzle": "upper_muzzle"})),
        },
    )
    graph.reward("landed", score)
    return graph


def state(target_x: float, target_y: float = TARGET_Y) -> dict[str, float | tuple[float, float]]:
    """What is known before the shot.

    Args:
        target_x: () [m].
        target_y: () [m].

    Returns:
        speed: () [m/s]; target, lower_muzzle, upper_muzzle: (2,) positions [m].
    """
    return {
        "speed": SPEED,
        "target": (target_x, target_y),
        "lower_muzzle": LOWER_MUZZLE,
        "upper_muzzle": UPPER_MUZZLE,
    }
