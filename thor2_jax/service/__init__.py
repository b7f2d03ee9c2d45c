"""Inference service: object names and descriptors of RGB-D frames and point clouds over HTTP (extra `serve`).

    thor2 serve --model run

Modules in the order of a request: `app` (routes), `uploads` (size limits, multipart forms), `pipeline` (admission and
stages), `preparation` (worker processes that decode images and compute instance clouds, with `decoding`), `batching`
(batches across requests), `engine` (the compiled model), `teaching` (requests that enroll and forget
objects), `answers` (JSON records). `page/` is the web page served at /.
"""
