"""Contact mechanics: the deformation and the forces of one sensor that is pressed against one object."""

from twin.mechanics.balance import Friction
from twin.mechanics.batch import ContactJob, ContactOutcome, press_many
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import SkinSolver
