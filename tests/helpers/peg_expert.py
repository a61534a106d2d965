"""A scripted controller of ``tactip/PegInsert-v0`` that knows what both sensors feel, and where it has moved the hand."""

import numpy as np

TOUCH_N, PRESS_N, JAM_N, DROP_MM, LIFT_MM = 0.3, 0.6, 2.0, 3.0, 4.0
PITCH_MM, WAY_MM, SEARCH_MM, JAMMED = 0.8, 0.6, 110.0, 25


def on_the_peg(env):
    """Force (3,) N and torque (3,) N mm of both sensors on the peg, in the world, about the middle between them."""
    scene, parts = env.scene, []
    places = {site: 1e3 * scene.data.site(site).xpos for site in scene.sensors}
    middle = np.mean(list(places.values()), axis=0)
    for site, place in places.items():
        turn, felt = scene.data.site(site).xmat.reshape(3, 3), scene.read(site)
        force = turn @ felt.force_n
        parts.append(np.concatenate([force, turn @ felt.torque_nmm + np.cross(place - middle, force)]))
    return np.sum(parts, axis=0)


class Expert:
    """Lowers the peg to the plate, slides it over the plate on a spiral until it drops, and pushes it in as the forces allow.

    If it finds nothing or jams, it lifts the peg and searches on a spiral the other way round.
    """

    def __init__(self, env):
        self.env, self.free, self.part, self.way, self.jammed = env, on_the_peg(env), "lower", 0.0, 0
        self.centre, self.side, self.top = env.hand[:2].copy(), 1.0, 0.0

    def act(self):
        env, felt = self.env, on_the_peg(self.env) - self.free
        press, off = -felt[2], self.centre - env.hand[:2]
        if self.part == "lift" and env.hand[2] > self.top + LIFT_MM and np.abs(off).max() < 0.1:
            self.part, self.way, self.side = "lower", 0.0, -self.side
        if self.part == "lift":
            return np.clip([*off, 1.0, -env.hand[3]], -1, 1)
        if self.part == "lower" and press > TOUCH_N:
            self.part, self.top = "search", env.hand[2]
        if self.part == "lower":
            return np.array([0.0, 0.0, -0.5, 0.0])
        if self.part == "search":
            self.way += WAY_MM * (press > TOUCH_N)
            if env.hand[2] < self.top - DROP_MM:
                self.part, self.jammed = "insert", 0
            elif self.way > SEARCH_MM:
                self.part = "lift"
            turn = np.sqrt(4 * np.pi * self.way / PITCH_MM)
            wanted = off + PITCH_MM * turn / (2 * np.pi) * np.array([np.cos(turn), self.side * np.sin(turn)])
            return np.clip([*wanted, 0.5 * (press - PRESS_N), 0.0], [-1, -1, -0.5, 0], [1, 1, 0.5, 0])
        self.jammed = self.jammed + 1 if press > JAM_N else 0
        if self.jammed > JAMMED:
            self.part = "lift"
        return np.clip([*(-0.5 * felt[:2]), -1.0 if press < JAM_N else 0.4, -0.02 * felt[3]], -1, 1)
