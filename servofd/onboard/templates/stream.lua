-- {{ file }}: sends what servos measure of themselves to the ground, as SRVP1, SRVP2, ... [deg] and SRVA1, ... [A].
-- Made by `servofd onboard --stream-only` {{ version }} for ArduPilot 4.6 or newer: copy it to APM/scripts, set SCR_ENABLE = 1.
local outputs = { {{ outputs | join(", ") }} }

local function send()
   for _, output in ipairs(outputs) do
      local telemetry = servo_telem:get_telem(output - 1)
      local position, current = telemetry and telemetry:measured_position(), telemetry and telemetry:current()
      if position then
         gcs:send_named_float("SRVP" .. output, position)
      end
      if current then
         gcs:send_named_float("SRVA" .. output, current)
      end
   end
   return send, {{ period_ms }}
end

if servo_telem then
   return send()
end
gcs:send_text(2, "servofd: needs ArduPilot 4.6 with servo telemetry")
