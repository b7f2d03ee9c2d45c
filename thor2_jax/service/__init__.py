"""Inference service: object names and descriptors of RGB-D frames and point clouds over HTTP (extra `serve`).

    thor2 serve --model run

Modules in the order of a request: `server` (connections), `app` (routes), `pipeline` (admission and stages), `decoding`
(size limits, multipart forms, images and clouds), `preparation` (worker processes that decode images and compute
instance clouds), `engine` (batches across requests, and the compiled model), `answers` (JSON records, whose fields are
in `schemas`). `page/` is the web page served at /. The live view (`thor2 watch`) also uses `hosts`.
"""
