"""The whole way on rendered frames: press, render, detect, graph, against exact truth."""

from functools import cache

import numpy as np
import pytest

from scenes import SpecError, load_object, load_sensor
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.one_contact import RenderedContact, look_at
from twin.pins.graph import make_graph
from twin.pins.labelling.reference import nominal_reference
from twin.pins.pipeline import Pipeline
from twin.simulator import Simulator
from twin.types import Form

CENTROID_RMS_PX = 0.3  # detected against projected caps, no contact
SLOPE_SHARE = 0.5  # a drag along one axis moves the pins at least this much more along it than across it
FORMS = [(name, form) for name in ("mg400-331", "mg400-127") for form in Form] + [pytest.param("ur5-331", Form.RAW, marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def simulators():
    specs = [load_sensor(name) for name in ("mg400-331", "mg400-127", "ur5-331")]
    return {spec.name: Simulator(spec, solver=SkinSolver(spec, resolution=Resolution(10))) for spec in specs}


@pytest.fixture(scope="module")
def at_rest(simulators):
    """A sensor's frame without contact in a form, and what the pipeline sees in it; each is rendered once."""

    @cache
    def make(name, form):
        rendered = simulators[name].render(simulators[name].rest, form=form)
        return rendered, Pipeline(simulators[name].spec, form)(rendered.frame)

    return make


@pytest.mark.parametrize(("name", "form"), FORMS)
def test_rendered_caps_are_found_where_they_project(simulators, at_rest, name, form):
    simulator = simulators[name]
    rendered, observation = at_rest(name, form)
    assert observation.found == simulator.spec.pins.count and rendered.truth.visible.all()
    error = observation.pins_px - rendered.truth.caps_px
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < CENTROID_RMS_PX


@pytest.mark.parametrize(("name", "delaunay"), [("mg400-331", 1860), ("ur5-331", 1860), ("mg400-127", 744)])
def test_edges_without_contact(simulators, at_rest, name, delaunay):
    simulator = simulators[name]
    _, observation = at_rest(name, Form.RAW)
    assert len(observation.graph.edges) == delaunay
    assert len(make_graph("knn", observation.pins_px).edges) == 6 * simulator.spec.pins.count


def test_cells_at_the_contact_grow_with_depth(simulators):
    simulator = simulators["mg400-331"]
    outmost = nominal_reference(simulator.spec, Form.RAW).outmost
    truth = [simulator.rest] + [simulator.press(load_object("plane"), ContactPose(indent_mm=d)) for d in (1.5, 3.0, 4.5)]
    from twin.camera.projection import project

    graphs = [make_graph("voronoi", project(simulator.spec.view, state.caps_mm), outmost=outmost) for state in truth]
    middle = np.arange(37)  # the inner three rings and the centre
    means = [graph.area_px2[middle].mean() for graph in graphs]
    assert means == sorted(means) and means[-1] > 1.1 * means[0]


def test_a_form_may_be_given_by_its_name(simulators):
    simulator = simulators["mg400-127"]
    for form in Form:
        rendered = simulator.render(simulator.rest, form=str(form))
        assert rendered.frame.form is form and rendered.frame.image.shape == simulator.render_rest(form).frame.image.shape


def test_a_name_is_no_specification(simulators):
    with pytest.raises(SpecError, match=r"give load_sensor\('mg400-127'\)"):
        Simulator("mg400-127")
    with pytest.raises(SpecError, match=r"give load_object\('sphere'\)"):
        simulators["mg400-127"].press("sphere", ContactPose(indent_mm=1.0))


@pytest.fixture(scope="module")
def pressed(simulators):
    simulator = simulators["mg400-127"]
    return simulator.render(simulator.press(load_object("plane"), ContactPose(indent_mm=3.0)))


@pytest.mark.parametrize(("axis", "sign"), [(1, -1), *(pytest.param(*more, marks=pytest.mark.slow) for more in ((0, 1), (0, -1), (1, 1)))])
def test_a_drag_carries_the_pins_along(simulators, pressed, axis, sign):
    simulator = simulators["mg400-127"]
    shear = [0.0, 0.0]
    shear[axis] = 2.0 * sign
    dragged = simulator.render(simulator.press(load_object("plane"), ContactPose(indent_mm=3.0, shear_mm=tuple(shear))))
    pipeline = Pipeline(simulator.spec, Form.RAW)
    moved = np.nanmean(pipeline(dragged.frame).pins_px - pipeline(pressed.frame).pins_px, axis=0)
    assert sign * moved[axis] > 1.0
    assert abs(moved[1 - axis]) < SLOPE_SHARE * abs(moved[axis])


def test_a_tilt_moves_the_contact_to_the_side_that_is_touched(simulators):
    simulator = simulators["mg400-331"]
    for tilt_deg, axis, sign in (((0.0, 12.0), 0, 1), ((0.0, -12.0), 0, -1), ((12.0, 0.0), 1, -1), ((-12.0, 0.0), 1, 1)):
        state = simulator.press(load_object("plane"), ContactPose(indent_mm=2.5, tilt_deg=tilt_deg))
        center = np.average(state.contact_mm, axis=0, weights=state.normal_n)
        assert sign * center[axis] > 1.0
        moved = np.linalg.norm(state.caps_mm - simulator.rest.caps_mm, axis=1)
        assert sign * np.average(simulator.rest.caps_mm[:, axis], weights=moved) > 0.3


def test_the_same_contact_gives_the_same_frame(simulators):
    simulator = simulators["mg400-127"]
    pose = ContactPose(indent_mm=2.0, twist_deg=5.0)
    states = [simulator.press(load_object("sphere"), pose) for _ in range(2)]
    assert np.array_equal(states[0].nodes_mm, states[1].nodes_mm)
    rendered = [simulator.render(state, seed=3) for state in states]
    assert np.array_equal(rendered[0].frame.image, rendered[1].frame.image)


def test_a_picture_in_which_the_pipeline_finds_no_pins_is_said():
    """The mask of this sensor looks beside the pins."""
    spec = load_sensor("mg400-127")
    aside = spec.pipeline.raw.model_copy(update={"mask_center_px": (60.0, 60.0), "mask_radius_px": 50.0})
    blind = spec.model_copy(update={"pipeline": spec.pipeline.model_copy(update={"raw": aside})})
    simulator = Simulator(blind, quality="rasterised")
    rendered = simulator.render(simulator.rest)
    said = RenderedContact(simulator.rest, rendered, look_at(simulator, rendered), [], simulator.spec.skin.stiffness_factor).lines()
    assert "note: the pipeline can't use the picture: too few pins" in said[1]
