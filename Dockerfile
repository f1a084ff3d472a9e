# Untested: written without Docker at hand.
#
#   docker build -t marl-explore .
#   docker run --rm -v "$PWD:/work" marl-explore explore docs/images/plan.png

FROM python:3.11 AS build
WORKDIR /source
COPY . .
RUN pip install build && python -m build --outdir /dist

FROM python:3.11-slim
COPY constraints.txt /tmp/
COPY --from=build /dist/*.whl /tmp/
RUN pip install --no-cache-dir -c /tmp/constraints.txt /tmp/*.whl && rm /tmp/*.whl
ENV OMP_NUM_THREADS=1
WORKDIR /work
ENTRYPOINT ["marl-explore"]
