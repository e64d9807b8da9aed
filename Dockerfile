# The command `ncs` with everything that trains and draws:
#   docker build -t ncs-gym .
#   docker run --rm -v "$PWD/runs:/project/runs" ncs-gym compare --smoke --out runs/compare
FROM python:3.11-slim

# torch without libraries for graphics cards; empty for pip's own index.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

WORKDIR /opt/ncs-gym
COPY constraints.txt ./
RUN pip install --no-cache-dir -c constraints.txt ${TORCH_INDEX:+--index-url $TORCH_INDEX} torch
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[train,contrib,render]'

# Runs as an ordinary user, in a folder of its own.
RUN useradd --create-home user && install -d -o user /project/runs
USER user
WORKDIR /project
ENTRYPOINT ["ncs"]
CMD ["--help"]
