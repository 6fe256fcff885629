// Print the markers that a gateway publishes on LCM.
//
//	make -C examples go && examples/build/subscriber_go [SOURCE [COUNT]]     for example: LAB 100
//	go run examples/subscriber.go [SOURCE [COUNT]]                           the same, without make
//
// Building needs Go 1.18 or newer and no other package: the program reads LCM's packets and the messages by the tables
// of docs/reference/messages.md. (lcm-gen cannot make Go code of these types.) SOURCE is the name of the source in upper
// case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets the LCM URL. With --vectors,
// the program decodes messages from standard input instead (lcm_types/vectors/README.md).
package main

import (
	"bufio"
	"bytes"
	"encoding/binary"
	"encoding/hex"
	"encoding/json"
	"errors"
	"fmt"
	"math"
	"net"
	"net/netip"
	"net/url"
	"os"
	"reflect"
	"strconv"
	"strings"
)

// The messages. decode fills their fields in this order; there is no padding between them. A slice has as many items as
// the field before it says.

// Message is a type of messages. The first 8 bytes of each are the fingerprint of its type.
type Message interface{ fingerprint() uint64 }

func (Markers) fingerprint() uint64  { return 0xe95d5a478ce229e4 }
func (Tools) fingerprint() uint64    { return 0xf922a353b61657b3 }
func (Analog) fingerprint() uint64   { return 0xcd43a9dd46669bec }
func (Forces) fingerprint() uint64   { return 0xdc94defbb591810c }
func (Events) fingerprint() uint64   { return 0x06a109c2ae7bf07c }
func (ToolPose) fingerprint() uint64 { return 0xbf985441ca59ae7a }

type Prefix struct {
	Utime             int64 `json:"utime"`
	CaptureUtime      int64 `json:"capture_utime"`
	Sequence          int64 `json:"sequence"`
	Session           int32 `json:"session"`
	ParametersVersion int32 `json:"parameters_version"`
	FrameNumber       int32 `json:"frame_number"`
	Timestamp         int64 `json:"timestamp"`
}

type Markers struct {
	Prefix
	NumMarkers int32    `json:"num_markers"`
	Markers    []Marker `json:"markers"`
}

type Tools struct {
	Prefix
	NumTools int32  `json:"num_tools"`
	Tools    []Tool `json:"tools"`
}

type Analog struct {
	Prefix
	NumChannels int32   `json:"num_channels"`
	Voltages    []Float `json:"voltages"`
}

type Forces struct {
	Prefix
	NumPlates int32   `json:"num_plates"`
	Plates    []Force `json:"plates"`
}

type Events struct {
	Prefix
	NumEvents int32   `json:"num_events"`
	Events    []Event `json:"events"`
}

type ToolPose struct {
	Prefix
	Visible         bool     `json:"visible"`
	PositionM       [3]Float `json:"position_m"`
	OrientationXYZW [4]Float `json:"orientation_xyzw"`
	ErrorM          Float    `json:"error_m"`
}

type Marker struct {
	X           Float `json:"x"`
	Y           Float `json:"y"`
	Z           Float `json:"z"`
	Reliability Float `json:"reliability"`
}

type Tool struct {
	Q0    Float `json:"q0"`
	Qx    Float `json:"qx"`
	Qy    Float `json:"qy"`
	Qz    Float `json:"qz"`
	X     Float `json:"x"`
	Y     Float `json:"y"`
	Z     Float `json:"z"`
	Error Float `json:"error"`
}

type Force struct {
	Fx Float `json:"fx"`
	Fy Float `json:"fy"`
	Fz Float `json:"fz"`
	Mx Float `json:"mx"`
	My Float `json:"my"`
	Mz Float `json:"mz"`
}

type Event struct {
	ID        int32 `json:"id"`
	Timestamp int64 `json:"timestamp"`
	Param1    int32 `json:"param1"`
	Param2    int32 `json:"param2"`
	Param3    int32 `json:"param3"`
}

// Float is a float32 that may be NaN, which JSON has no number for.
type Float float32

func (f Float) MarshalJSON() ([]byte, error) {
	value := float64(f)
	switch {
	case math.IsNaN(value):
		return []byte(`"nan"`), nil
	case math.IsInf(value, 1):
		return []byte(`"inf"`), nil
	case math.IsInf(value, -1):
		return []byte(`"-inf"`), nil
	}
	return strconv.AppendFloat(nil, value, 'g', -1, 32), nil
}

// decode returns the message, or an error for bytes that are not a whole message of type M.
func decode[M Message](data []byte) (*M, error) {
	message := new(M)
	if len(data) < 8 || binary.BigEndian.Uint64(data) != (*message).fingerprint() {
		return nil, errors.New("it has the fingerprint of another type")
	}
	body := bytes.NewReader(data[8:])
	fields := reflect.ValueOf(message).Elem()
	for i := 0; i < fields.NumField(); i++ {
		field := fields.Field(i)
		if field.Kind() == reflect.Slice {
			count, itemSize := fields.Field(i-1).Int(), binary.Size(reflect.Zero(field.Type().Elem()).Interface())
			if count*int64(itemSize) != int64(body.Len()) {
				return nil, fmt.Errorf("%d bytes are not %d items", body.Len(), count)
			}
			field.Set(reflect.MakeSlice(field.Type(), int(count), int(count)))
		}
		if err := binary.Read(body, binary.BigEndian, field.Addr().Interface()); err != nil {
			return nil, err
		}
	}
	if body.Len() > 0 {
		return nil, fmt.Errorf("there are %d bytes behind its end", body.Len())
	}
	return message, nil
}

// LCM's packets: a whole message, or a fragment of one.

const (
	magicMessage    = 0x4c433032 // "LC02"
	magicFragment   = 0x4c433033 // "LC03"
	maxMessageBytes = 1 << 20
	maxSenders      = 8
)

type fragmentHeader struct {
	MessageBytes, Offset uint32
	Number, Count        uint16
}

type partialMessage struct {
	sequence uint32
	channel  string
	data     []byte
	received []bool
	missing  int
}

// assembler joins the fragments of messages. Like LCM itself, it keeps one incomplete message for each sender.
type assembler map[netip.AddrPort]*partialMessage

// add returns the message that a packet completes. If it completes none, the channel is empty.
func (a assembler) add(sender netip.AddrPort, packet []byte) (channel string, message []byte) {
	if len(packet) < 8 {
		return "", nil
	}
	magic, sequence, rest := binary.BigEndian.Uint32(packet), binary.BigEndian.Uint32(packet[4:]), packet[8:]
	if magic == magicMessage {
		return cutChannel(rest)
	}
	var header fragmentHeader
	body := bytes.NewReader(rest)
	if magic != magicFragment || binary.Read(body, binary.BigEndian, &header) != nil || header.MessageBytes > maxMessageBytes {
		return "", nil
	}
	return a.addFragment(sender, sequence, header, rest[len(rest)-body.Len():])
}

func (a assembler) addFragment(sender netip.AddrPort, sequence uint32, header fragmentHeader, data []byte) (string, []byte) {
	size, offset, number, count := int(header.MessageBytes), int(header.Offset), int(header.Number), int(header.Count)
	partial := a[sender]
	if partial == nil || partial.sequence != sequence || len(partial.data) != size || len(partial.received) != count {
		for other := range a {
			if len(a) >= maxSenders {
				delete(a, other)
			}
		}
		partial = &partialMessage{sequence, "", make([]byte, size), make([]bool, count), count}
		a[sender] = partial
	}
	if number == 0 {
		partial.channel, data = cutChannel(data)
	}
	if number >= count || partial.received[number] || offset > size-len(data) {
		return "", nil
	}
	copy(partial.data[offset:], data)
	partial.received[number] = true
	partial.missing--
	if partial.missing > 0 {
		return "", nil
	}
	delete(a, sender)
	return partial.channel, partial.data
}

// cutChannel splits the name of the channel, which ends with a NUL, from the data behind it.
func cutChannel(data []byte) (string, []byte) {
	channel, rest, found := bytes.Cut(data, []byte{0})
	if !found {
		return "", data
	}
	return string(channel), rest
}

// The subscriber.

// openLCM joins the multicast group of $LCM_DEFAULT_URL, such as udpm://239.255.76.67:7667?ttl=1.
func openLCM() (*net.UDPConn, error) {
	text := os.Getenv("LCM_DEFAULT_URL")
	if text == "" {
		text = "udpm://239.255.76.67:7667"
	}
	address, err := url.Parse(text)
	if err != nil {
		return nil, err
	}
	if address.Scheme != "udpm" {
		return nil, fmt.Errorf("%s: this program can only use udpm", text)
	}
	group, err := net.ResolveUDPAddr("udp4", address.Host)
	if err != nil {
		return nil, err
	}
	connection, err := net.ListenMulticastUDP("udp4", nil, group)
	if err != nil {
		return nil, err
	}
	return connection, connection.SetReadBuffer(2_000_000) // Linux allows at most net.core.rmem_max
}

func subscribe(source string, count int) error {
	connection, err := openLCM()
	if err != nil {
		return err
	}
	fmt.Println("listening")
	messages, packet := assembler{}, make([]byte, 65536)
	for received := 0; count == 0 || received < count; {
		length, sender, err := connection.ReadFromUDPAddrPort(packet)
		if err != nil {
			return err
		}
		channel, data := messages.add(sender, packet[:length])
		if channel != "MOCAP_"+source+"_3D" {
			continue
		}
		message, err := decode[Markers](data)
		if err != nil {
			fmt.Fprintf(os.Stderr, "ignored a malformed message on %s: %v\n", channel, err)
			continue
		}
		printMarkers(message)
		received++
	}
	return nil
}

func printMarkers(message *Markers) {
	var visible []Marker
	for _, marker := range message.Markers {
		if !math.IsNaN(float64(marker.X)) {
			visible = append(visible, marker)
		}
	}
	fmt.Printf("#%d frame %d at %.4f s with parameters %d: %d of %d markers in view", message.Sequence,
		message.FrameNumber, float64(message.Timestamp)/1e6, message.ParametersVersion, len(visible), message.NumMarkers)
	if len(visible) > 0 {
		fmt.Printf(", the first at %.3f, %.3f, %.3f mm", visible[0].X, visible[0].Y, visible[0].Z)
	}
	fmt.Println()
}

// decoders has the types that --vectors decodes.
var decoders = map[string]func([]byte) (any, error){
	"markers_t":   decodeAny[Markers],
	"tools_t":     decodeAny[Tools],
	"analog_t":    decodeAny[Analog],
	"forces_t":    decodeAny[Forces],
	"events_t":    decodeAny[Events],
	"tool_pose_t": decodeAny[ToolPose],
}

func decodeAny[M Message](data []byte) (any, error) { return decode[M](data) }

// decodeLine decodes a line "TYPE HEX".
func decodeLine(line string) (any, error) {
	typeName, digits, _ := strings.Cut(strings.TrimSpace(line), " ")
	decoder, ok := decoders[typeName]
	if !ok {
		return nil, fmt.Errorf("no type %q", typeName)
	}
	data, err := hex.DecodeString(digits)
	if err != nil {
		return nil, err
	}
	return decoder(data)
}

// printVectors decodes each line "TYPE HEX" of standard input, and prints one line of JSON for it.
func printVectors() error {
	lines := bufio.NewScanner(os.Stdin)
	lines.Buffer(nil, math.MaxInt)
	output := json.NewEncoder(os.Stdout)
	for lines.Scan() {
		decoded, err := decodeLine(lines.Text())
		if err != nil {
			decoded = map[string]string{"error": err.Error()}
		}
		if err := output.Encode(decoded); err != nil {
			return err
		}
	}
	return lines.Err()
}

func run(arguments []string) error {
	source, count := "LAB", 0
	if len(arguments) > 0 && strings.HasPrefix(arguments[0], "-") {
		if arguments[0] == "--vectors" {
			return printVectors()
		}
		fmt.Println("Print the markers that a gateway publishes on LCM.\nusage: subscriber_go [SOURCE [COUNT]] | --vectors")
		if arguments[0] != "--help" {
			os.Exit(2)
		}
		return nil
	}
	if len(arguments) > 0 {
		source = arguments[0]
	}
	if len(arguments) > 1 {
		number, err := strconv.ParseUint(arguments[1], 10, 31)
		if err != nil {
			return fmt.Errorf("COUNT must be a number, not %s", arguments[1])
		}
		count = int(number)
	}
	if err := subscribe(source, count); err != nil {
		return fmt.Errorf("cannot receive from LCM; check $LCM_DEFAULT_URL and the multicast route: %w", err)
	}
	return nil
}

func main() {
	if err := run(os.Args[1:]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}
