"""`thor2 colornet`: build the colour network."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli.app import app, console


@app.command()
def colornet(
    out: Annotated[Path, typer.Option(help="New directory for network.npz, network.png and similarity.png.")],
) -> None:
    """Build the colour network from scratch and draw it."""
    import colornet as colornet_package
    from colornet.draw import draw_network, draw_similarity
    from thor2_jax.files import atomic_directory, check_output_directory

    check_output_directory(out)
    network = colornet_package.build()
    with atomic_directory(out) as directory:
        network.save(directory / "network.npz")
        draw_network(network, directory / "network.png")
        draw_similarity(network, directory / "similarity.png")
    same = network.fingerprint == colornet_package.load_default().fingerprint
    console.print(
        f"{network.n_raw_nodes} raw nodes, {network.n_regions} regions, {len(network.edges)} edges; "
        f"{'equal to' if same else 'DIFFERENT from'} the packaged network; "
        f"written to {out}; use it with: colornet.load({str(out / 'network.npz')!r})"
    )
