"""A client of Home Assistant's REST and websocket API, as the frontend is."""

from collections.abc import Mapping
from http import HTTPStatus
from itertools import count
from typing import Any, Self

import aiohttp

from .settings import DemoError


class Client:
    """A client of one Home Assistant; use with `async with`."""

    def __init__(self, url: str, token: str) -> None:
        """Prepare; nothing is sent yet."""
        self._url = url
        self._token = token
        self._session = aiohttp.ClientSession(
            headers={"Authorization": f"Bearer {token}"}
        )
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._ids = count(1)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close what is open."""
        if self._socket is not None:
            await self._socket.close()
        await self._session.close()

    async def running(self) -> tuple[bool, int]:
        """Return whether everything is set up, and the number of components so far."""
        try:
            async with self._session.get(f"{self._url}/api/config") as answer:
                if answer.status == HTTPStatus.UNAUTHORIZED:
                    raise DemoError(
                        "Home Assistant no longer accepts the token; remove the demo's"
                        " folder to start again"
                    )
                if answer.status != HTTPStatus.OK:
                    return False, 0
                config = await answer.json()
        except aiohttp.ClientError:
            return False, 0
        components = [name for name in config["components"] if "." not in name]
        return config["state"] == "RUNNING", len(components)

    async def get(self, path: str) -> Any:  # noqa: ANN401 - as the API answers
        """Return the result of GET; raises DemoError."""
        return await self._request("GET", path)

    async def post(self, path: str, data: Mapping[str, Any]) -> Any:  # noqa: ANN401
        """Return the result of POST; raises DemoError."""
        return await self._request("POST", path, data)

    async def delete(self, path: str) -> Any:  # noqa: ANN401
        """Return the result of DELETE; raises DemoError."""
        return await self._request("DELETE", path)

    async def _request(
        self, method: str, path: str, data: Mapping[str, Any] | None = None
    ) -> Any:  # noqa: ANN401
        async with self._session.request(
            method, f"{self._url}/api/{path}", json=data
        ) as answer:
            if not answer.ok:
                text = await answer.text()
                raise DemoError(f"{method} {path}: {answer.status} {text}")
            return await answer.json()

    async def command(self, kind: str, **values: object) -> Any:  # noqa: ANN401
        """Return the result of a websocket command; raises DemoError."""
        socket = await self._connected()
        number = next(self._ids)
        await socket.send_json({"id": number, "type": kind, **values})
        while (answer := await socket.receive_json())["id"] != number:
            pass
        if not answer["success"]:
            raise DemoError(f"{kind}: {answer['error']['message']}")
        return answer["result"]

    async def _connected(self) -> aiohttp.ClientWebSocketResponse:
        if self._socket is None or self._socket.closed:
            socket = await self._session.ws_connect(
                f"{self._url}/api/websocket", max_msg_size=0
            )
            await socket.receive_json()
            await socket.send_json({"type": "auth", "access_token": self._token})
            if (await socket.receive_json())["type"] != "auth_ok":
                raise DemoError("Home Assistant does not accept the token")
            self._socket = socket
        return self._socket
