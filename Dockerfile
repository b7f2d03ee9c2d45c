# docker build -t thor2 . && docker run --rm -p 127.0.0.1:8080:8080 -v "$PWD/run:/run-folder:ro" thor2
# Under a name other than localhost, append: --allow-host robot.local
FROM python:3.11-slim

WORKDIR /app
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY colornet colornet
COPY thor2_jax thor2_jax
COPY training training
RUN pip install --no-cache-dir -c constraints.txt '.[serve,segment]' \
    && useradd --system --uid 10001 --no-create-home thor2

USER thor2
WORKDIR /
EXPOSE 8080
# /readyz returns 503 until the programs are compiled (up to a minute).
HEALTHCHECK --interval=10s --timeout=3s --start-period=120s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8080/readyz', timeout=2)"]
ENTRYPOINT ["thor2", "serve", "--model", "/run-folder", "--host", "0.0.0.0", "--port", "8080"]
