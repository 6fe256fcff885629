// Print the markers that a gateway publishes on LCM.
//
//   make -C examples java && java -jar examples/build/subscriber.jar [SOURCE [COUNT]]     for example: LAB 100
//
// Building needs a JDK (11 or newer), make, and the Python package lcm, which has lcm.jar and lcm-gen. SOURCE is the
// name of the source in upper case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets
// the LCM URL. With --vectors, the program decodes messages from standard input instead (lcm_types/vectors/README.md).

import static java.nio.charset.StandardCharsets.ISO_8859_1;
import static java.nio.charset.StandardCharsets.UTF_8;

import java.io.BufferedReader;
import java.io.DataInput;
import java.io.IOException;
import java.io.InputStreamReader;
import java.io.PrintStream;
import java.lang.reflect.Array;
import java.lang.reflect.Field;
import java.lang.reflect.Modifier;
import java.nio.ByteBuffer;
import java.nio.charset.CharacterCodingException;
import java.util.Locale;
import java.util.StringJoiner;
import java.util.concurrent.CountDownLatch;
import lcm.lcm.LCM;
import lcm.lcm.LCMDataInputStream;

public final class Subscriber {
    private static final PrintStream out = new PrintStream(System.out, true, UTF_8);

    public static void main(String[] arguments) throws Exception {
        if (arguments.length > 0 && arguments[0].equals("--vectors")) {
            printVectors();
        } else if (arguments.length > 0 && arguments[0].startsWith("-")) {
            out.println("Print the markers that a gateway publishes on LCM.");
            out.println("Arguments: [SOURCE [COUNT]], or --vectors < LINES");
            System.exit(arguments[0].equals("--help") ? 0 : 2);
        } else {
            String count = arguments.length > 1 ? arguments[1] : "0";
            if (!count.matches("[0-9]{1,9}")) {
                System.err.println("COUNT must be a number, not " + count);
                System.exit(1);
            }
            try {
                subscribe(arguments.length > 0 ? arguments[0] : "LAB", Integer.parseInt(count));
            } catch (IOException error) {
                System.err.println("Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route: " + error);
                System.exit(1);
            }
        }
    }

    private static void subscribe(String source, int count) throws Exception {
        CountDownLatch framesLeft = new CountDownLatch(count == 0 ? Integer.MAX_VALUE : count);
        LCM lcm = openLcm();
        lcm.subscribe("MOCAP_" + source + "_3D", (from, channel, input) -> {
            try {
                byte[] data = new byte[input.available()];
                input.readFully(data);
                if (framesLeft.getCount() > 0) {
                    printMarkers((rtc3d.markers_t) decode("markers_t", data));
                }
                framesLeft.countDown();
            } catch (IOException error) {
                System.err.println("ignored a malformed message on " + channel + ": " + error.getMessage());
            }
        });
        out.println("listening");
        framesLeft.await();
        System.exit(0); // closing LCM would wait for one more message, and then print an error
    }

    private static LCM openLcm() throws IOException {
        try {
            return new LCM();
        } catch (RuntimeException error) { // a URL that LCM cannot use
            throw new IOException(error.getMessage());
        }
    }

    private static void printMarkers(rtc3d.markers_t message) {
        rtc3d.marker_t first = null;
        int visible = 0;
        for (rtc3d.marker_t marker : message.markers) {
            if (!Float.isNaN(marker.x)) {
                visible++;
                first = first == null ? marker : first;
            }
        }
        String line = String.format(
                Locale.ROOT,
                "#%d frame %d at %.4f s with parameters %d: %d of %d markers in view",
                message.sequence,
                message.frame_number,
                message.timestamp / 1e6,
                message.parameters_version,
                visible,
                message.num_markers);
        if (first != null) {
            line += String.format(Locale.ROOT, ", the first at %.3f, %.3f, %.3f mm", first.x, first.y, first.z);
        }
        out.println(line);
    }

    /** Return the message as an object of its class. */
    private static Object decode(String typeName, byte[] data) throws IOException {
        try {
            Class<?> type = Class.forName("rtc3d." + typeName);
            ByteBuffer content = ByteBuffer.wrap(data).position(Math.min(data.length, Long.BYTES));
            skip(type, content);
            if (!content.hasRemaining()) {
                return type.getConstructor(DataInput.class).newInstance(new LCMDataInputStream(data));
            }
        } catch (ReflectiveOperationException | RuntimeException | CharacterCodingException error) {
            // An unknown type, a wrong fingerprint, a message that ends too early, or an impossible number or text.
        }
        throw new IOException(data.length + " bytes are not a whole " + typeName);
    }

    /**
     * Move behind a value. Throws one of several exceptions if it is not there, or is a text that is not UTF-8.
     *
     * <p>The classes of lcm-gen allocate as many items as a message says that it has. So that a damaged message does not
     * fill the memory, this looks first whether there are as many.
     */
    private static void skip(Class<?> type, ByteBuffer data)
            throws ReflectiveOperationException, CharacterCodingException {
        if (type == long.class || type == double.class) {
            data.getLong();
        } else if (type == int.class || type == float.class) {
            data.getInt();
        } else if (type == boolean.class) {
            data.get();
        } else if (type == String.class) {
            byte[] text = new byte[Math.min(data.getInt() - 1, data.remaining())];
            data.get(text);
            UTF_8.newDecoder().decode(ByteBuffer.wrap(text));
            if (data.get() != 0) {
                throw new IllegalArgumentException("a text without an end");
            }
        } else {
            Object empty = type.getConstructor().newInstance();
            int numItems = 0;
            for (Field field : type.getFields()) {
                if (field.getType().isArray()) {
                    Object fixed = field.get(empty);
                    int count = fixed == null ? numItems : Array.getLength(fixed);
                    for (int i = 0; i < count; i++) {
                        skip(field.getType().getComponentType(), data);
                    }
                } else if (field.getType() == int.class) {
                    numItems = data.getInt();
                } else if (!Modifier.isStatic(field.getModifiers())) {
                    skip(field.getType(), data);
                }
            }
        }
    }

    /** Read lines TYPE HEX, and print the values of each message, or what is wrong, as a line of JSON. */
    private static void printVectors() throws IOException, IllegalAccessException {
        BufferedReader input = new BufferedReader(new InputStreamReader(System.in, UTF_8));
        for (String line = input.readLine(); line != null; line = input.readLine()) {
            String[] words = line.trim().split(" ");
            try {
                out.println(toJson(decode(words[0], decodeHex(words.length > 1 ? words[1] : ""))));
            } catch (IOException error) {
                out.println("{\"error\": " + quoted(error.getMessage()) + "}");
            }
        }
    }

    private static byte[] decodeHex(String digits) throws IOException {
        if (digits.length() % 2 != 0 || !digits.matches("[0-9a-fA-F]*")) {
            throw new IOException("this is not hexadecimal");
        }
        byte[] data = new byte[digits.length() / 2];
        for (int i = 0; i < data.length; i++) {
            data[i] = (byte) Integer.parseInt(digits.substring(2 * i, 2 * i + 2), 16);
        }
        return data;
    }

    private static String toJson(Object value) throws IllegalAccessException {
        if (value instanceof String) {
            // The classes of lcm-gen make each byte of a text a character. The gateway's texts are UTF-8.
            return quoted(new String(((String) value).getBytes(ISO_8859_1), UTF_8));
        }
        if (value instanceof Float || value instanceof Double) {
            double number = ((Number) value).doubleValue();
            if (Double.isFinite(number)) {
                return value.toString();
            }
            return Double.isNaN(number) ? "\"nan\"" : number > 0 ? "\"inf\"" : "\"-inf\"";
        }
        if (value instanceof Number || value instanceof Boolean) {
            return value.toString();
        }
        if (value.getClass().isArray()) {
            StringJoiner items = new StringJoiner(", ", "[", "]");
            for (int i = 0; i < Array.getLength(value); i++) {
                items.add(toJson(Array.get(value, i)));
            }
            return items.toString();
        }
        StringJoiner fields = new StringJoiner(", ", "{", "}");
        for (Field field : value.getClass().getFields()) {
            if (!Modifier.isStatic(field.getModifiers())) {
                fields.add("\"" + field.getName() + "\": " + toJson(field.get(value)));
            }
        }
        return fields.toString();
    }

    private static String quoted(String text) {
        StringBuilder quoted = new StringBuilder("\"");
        for (char letter : text.toCharArray()) {
            if (letter < ' ') {
                quoted.append(String.format("\\u%04x", (int) letter));
            } else {
                quoted.append(letter == '"' || letter == '\\' ? "\\" : "").append(letter);
            }
        }
        return quoted.append('"').toString();
    }
}
