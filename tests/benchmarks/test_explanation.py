"""The benchmark of explanations."""

from benchmarks.explanation import summary
from thor2_jax.explanation.attributions import Faithfulness


def test_summary_counts_faithful_instances() -> None:
    checks = [Faithfulness(5.0, 2.0, 0.5), Faithfulness(5.0, 0.1, 0.5), Faithfulness(1.0, -0.1, -0.4)]
    assert summary(checks) == {
        "instances": 3,
        "faithful": 2 / 3,
        "loss_without_most_attributed_tenth": 0.1,
        "loss_without_random_tenth": 0.5,
    }
