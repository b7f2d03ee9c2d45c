"""Inference service: object names and descriptors of RGB-D frames and point clouds over HTTP (extra `serve`).

    thor2 serve --model run

Modules in the order of a request: `server` (connections), `app` (routes), `forms` (size limits, multipart forms),
`pipeline` (admission and stages), `preparation` (worker processes that decode images and compute instance clouds, with
`decoding`), `engine` (batches across requests, and the compiled model), `answers` (JSON records, whose fields are in
`schemas`). `page/` is the web page served at /; `hosts` and `signals` hold functions that the service shares with
the live view (`thor2 watch`) and with worker pools.
"""
