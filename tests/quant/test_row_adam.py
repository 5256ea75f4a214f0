import torch

from kfgs.quant.row_adam import RowAdam


def gradients(steps, K, dim):
    return torch.randn(steps, K, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def run_torch(rows, gradients):
    leaf = rows.clone().requires_grad_()
    optimizer = torch.optim.Adam([leaf], lr=8e-4, eps=1e-9)
    for gradient in gradients:
        leaf.grad = gradient.clone()
        optimizer.step()
    return leaf.detach()


def test_agrees_with_torch_when_rows_stay():
    rows = torch.ones(3, 4, dtype=torch.float64)
    adam = RowAdam(rows, learning_rate=8e-4, eps=1e-9)
    for gradient in gradients(20, 3, 4):
        adam.step(gradient)
    torch.testing.assert_close(adam.rows, run_torch(rows, gradients(20, 3, 4)), rtol=0, atol=1e-12)
    assert rows.eq(1).all()


def test_each_row_runs_as_if_it_were_alone():
    """Rows 0 and 2 stay for 20 steps, row 1 leaves after 8 and a new row joins: each is torch's Adam on its own."""
    steps = gradients(20, 4, 5)
    rows = torch.arange(20, dtype=torch.float64).reshape(4, 5)
    adam = RowAdam(rows[:3], learning_rate=8e-4, eps=1e-9)
    for gradient in steps[:8]:
        adam.step(gradient[:3])
    adam.keep(torch.tensor([0, 2]))
    adam.append(rows[3:])
    for gradient in steps[8:]:
        adam.step(gradient[[0, 2, 3]])
    expected = torch.cat(
        [run_torch(rows[[0, 2]], steps[:, [0, 2]]), run_torch(rows[3:], steps[8:, 3:])],
    )
    torch.testing.assert_close(adam.rows, expected, rtol=0, atol=1e-12)
