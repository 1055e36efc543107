"""The sentences of the usual checks, each once: other tests ask which argument an error names."""

import jax
import jax.numpy as jnp
import pytest

import jimpact as ji
from jimpact.tools import checks

SENTENCES = {
    "Argument `e` must lie in [0, 1], but has value 1.2.": lambda: checks.check_values(
        "e", 1.2, low=0.0, high=1.0
    ),
    "Argument `k` must lie in (0, inf), but has value 0 at index 1.": lambda: (
        checks.check_values("k", jnp.array([1.0, 0.0]), low=0.0, open_low=True)
    ),
    "Argument `q` must be finite, but has value nan at index (1, 0).": lambda: (
        checks.check_values("q", jnp.array([[0.0], [jnp.nan]]))
    ),
    "Argument `starts` must be an int >= 1, but has value 0.5.": lambda: (
        checks.as_whole("starts", 0.5, 1)
    ),
    "Argument `kind` must be one of plain, other, but has value 'third'. Did you mean other?": (
        lambda: checks.check_choice("kind", "third", ["plain", "other"])
    ),
    "Argument `v` must have shape (3,) (one per coordinate), but has shape (2,).": (
        lambda: checks.check_shape("v", jnp.zeros(2), (3,), "one per coordinate")
    ),
    "Argument `e` must be a scalar or have shape (2,), one value per contact, but has "
    "shape (3,).": lambda: checks.check_per_contact("e", jnp.zeros(3), 2),
    "Argument `ratios` must be a scalar or have one axis, but has shape (1, 2).": (
        lambda: checks.as_axis("ratios", jnp.ones((1, 2)))
    ),
    "Argument `matrix` must be a square matrix, but has shape (2, 3).": lambda: (
        checks.check_square("matrix", jnp.zeros((2, 3)))
    ),
    "Argument `v` must be numeric, but has value 'fast'.": lambda: (
        checks.as_float_array("v", "fast")
    ),
    "Argument `scene` must be of type Scene, but is 3.": lambda: checks.check_kind(
        "scene", 3, ji.Scene
    ),
    "Argument `drag` must be a function, but is 3.": lambda: checks.check_function(
        "drag", 3
    ),
}


@pytest.mark.parametrize("sentence", SENTENCES)
def test_a_check_names_the_argument_its_value_and_what_is_allowed(sentence):
    with pytest.raises((ValueError, TypeError)) as error:
        SENTENCES[sentence]()
    assert str(error.value) == sentence


def test_numbers_that_are_traced_are_refused_on_the_host():
    with pytest.raises(TypeError, match="under jit, vmap or grad"):
        jax.jit(lambda x: checks.check_concrete("law", x))(1.0)


def test_a_name_that_results_lack_gets_the_one_to_write():
    pair = ji.chain([1.0, 1.0])
    out = ji.impact(ji.Newton(0.8), pair, [1.0, 0.0])
    with pytest.raises(AttributeError, match=r"`v`.*velocity"):
        _ = out.v
    with pytest.raises(AttributeError, match=r"`velocty`.*velocity"):
        _ = out.velocty
    with pytest.raises(AttributeError, match=r"`W`.*normal_delassus"):
        _ = ji.Contact([[1.0]], [-1.0]).W
    assert not hasattr(out, "__array__")


def test_an_error_inside_of_a_property_is_not_that_of_its_name():
    @checks.suggesting_names()
    class Broken:
        @property
        def value(self):
            return self.part

    with pytest.raises(AttributeError, match=r"`part`"):
        _ = Broken().value
