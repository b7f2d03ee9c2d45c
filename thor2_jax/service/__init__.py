"""The inference service: frames and clouds over HTTP to names and descriptors (extra `serve`).

    thor2 serve --model run

A request's way: `app` takes it in (`uploads`: limits, multipart), `running` leads it on. `preparing` decodes it
(`decoding`) and makes clouds, in processes of its own; `batching` puts the clouds of all waiting requests into batches,
which `engine` gives to the device; `answers` makes the records that go back. `page/` is the web page at /.
"""
