"""oneDNN's float32 products: taken where they are exact, left where they are not, and put back after."""

import pytest
import torch

from ctm_plugin.cpu import products
from ctm_plugin.cpu.products import MAX_ERROR, PRODUCT_SHAPES, fast_products, product_error

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _as_it_was():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    products._exact.cache_clear()
    yield
    products._exact.cache_clear()
    torch.set_float32_matmul_precision(before)


def test_products_stay_float32():
    """Whatever this processor is; also of shapes that were not tried."""
    with fast_products(CPU):
        for shape in (*PRODUCT_SHAPES, (1, 3, 5), (4096, 64, 256), (257, 129, 65), (256, 4096, 256)):
            assert product_error(*shape) < MAX_ERROR


@pytest.mark.parametrize("error", [1e-7, 3e-3], ids=["exact", "rounds"])
def test_taken_where_exact(monkeypatch, error):
    monkeypatch.setattr(products, "product_error", lambda *shape: error if shape == PRODUCT_SHAPES[2] else 1e-7)
    with fast_products(CPU) as taken:
        assert taken == (error < MAX_ERROR)
        assert torch.get_float32_matmul_precision() == ("medium" if taken else "highest")
    assert torch.get_float32_matmul_precision() == "highest"


def test_other_devices_and_a_users_choice_are_left_alone():
    with fast_products(torch.device("cuda")) as taken:
        assert not taken
        assert torch.get_float32_matmul_precision() == "highest"
    torch.set_float32_matmul_precision("high")
    with fast_products(CPU) as taken:
        assert not taken
    assert torch.get_float32_matmul_precision() == "high"


def test_rounding_to_bfloat16_would_be_seen():
    a, b = torch.randn(64, 32), torch.randn(32, 16)
    rounded = (a.bfloat16().float() @ b.bfloat16().float()).double()
    exact = a.double() @ b.double()
    assert (rounded - exact).norm() / exact.norm() > 100 * MAX_ERROR
