"""Contact mechanics: the deformation and the forces of one sensor that is pressed against one object."""

from twin.mechanics.law import ContactLaw, Friction
from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import ContactJob, ContactOutcome, SkinSolver, press_many
