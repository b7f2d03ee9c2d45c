"""A live page with the recognized objects of a recording or a camera, served locally (`thor2 watch`)."""
