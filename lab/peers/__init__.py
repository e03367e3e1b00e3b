"""tactflow and its alternatives from the package index, on the same frames.

    make peers          # an environment with the peers, .venv-peers
    make peers-page     # measures, and writes docs/peers.md with its plots and docs/peers.json

`dots`, `contact` and `depth` hold the adapters, which are what a user of each package writes, and how each
quantity is measured; `page` writes the page from the numbers.
"""
